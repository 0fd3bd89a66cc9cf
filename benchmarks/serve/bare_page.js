// What the least page would do that draws a turning ball under the hand: one WebGL program, one draw call a picture, at the window's own size.
() => {
  document.body.style.margin = '0';
  const canvas = document.createElement('canvas');
  canvas.className = 'stage';
  [canvas.width, canvas.height] = [innerWidth, innerHeight];
  canvas.style.cssText = 'display: block; width: 100vw; height: 100vh';
  document.body.append(canvas);
  const gl = canvas.getContext('webgl2', { antialias: true });
  const program = gl.createProgram();
  const attach = (type, source) => {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  };
  attach(
    gl.VERTEX_SHADER,
    `#version 300 es
    in vec3 place; uniform float turn; out vec3 normal;
    void main() {
      float c = cos(turn), s = sin(turn);
      normal = vec3(c * place.x + s * place.y, c * place.y - s * place.x, place.z);
      gl_Position = vec4(normal.x * 0.6, normal.z * 0.8, normal.y * 0.5, 1);
    }`,
  );
  attach(
    gl.FRAGMENT_SHADER,
    `#version 300 es
    precision highp float; in vec3 normal; out vec4 colour;
    void main() { colour = vec4(pow(vec3(0.2) + max(normalize(normal), 0.0), vec3(0.45)), 1); }`,
  );
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
  gl.useProgram(program);
  const [rows, columns] = [20, 32];
  const at = (row, column) => {
    const [polar, azimuth] = [(Math.PI * row) / rows, (2 * Math.PI * column) / columns];
    return [Math.sin(polar) * Math.cos(azimuth), Math.sin(polar) * Math.sin(azimuth), Math.cos(polar)];
  };
  const places = [];
  for (let i = 0; i < rows; i++)
    for (let j = 0; j < columns; j++) places.push(at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j), at(i + 1, j + 1), at(i, j + 1));
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(places.flat()), gl.STATIC_DRAW);
  const place = gl.getAttribLocation(program, 'place');
  gl.enableVertexAttribArray(place);
  gl.vertexAttribPointer(place, 3, gl.FLOAT, false, 0, 0);
  gl.enable(gl.DEPTH_TEST);
  gl.clearColor(0.1, 0.1, 0.1, 1);
  let [turn, drawn, asked] = [0, 0, false];
  const draw = () => {
    asked = false;
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniform1f(gl.getUniformLocation(program, 'turn'), turn);
    gl.drawArrays(gl.TRIANGLES, 0, places.length);
    canvas.dataset.localFrames = String(++drawn);
  };
  addEventListener('pointermove', (event) => {
    turn = event.clientX / 100;
    if (asked) return;
    asked = true;
    requestAnimationFrame(draw);
  });
};
