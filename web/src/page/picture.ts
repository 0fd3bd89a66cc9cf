/** Draws the object and its sky with WebGL 2, and nothing else: no engine, so that the page stays small and quick without a graphics card. */

import type { Vec3 } from '../session/view';
import { lightSheet, sheetHeight, SHEET_WIDTH, turnHarmonics } from './light';
import type { View } from './orbit';
import { VERTEX_BYTES, wear, type PageLight, type PageMesh, type PageObject } from './page_object';
import { objectFragment, objectVertex, SHADED_FRAGMENT, SKY_VERTEX, skyFragment } from './shaders';

/** Level at which the sky is shown behind the object: out of focus, as behind a portrait. */
const SKY_LEVEL = 2;

/** A value for all of the object, or null: as captured. */
export interface MaterialChoice {
  /** Linear. */
  albedo: Vec3 | null;
  roughness: number | null;
  metallic: number | null;
  /** Times the albedo, linear. */
  tint: Vec3;
}

export interface PageFrame {
  view: View;
  /** Counter-clockwise, seen from above [degrees]. */
  rotation: number;
  exposureStops: number;
  material: MaterialChoice;
  sky: boolean;
  /** Of the object's meshes, finest first; all but that are shaded at their vertices. */
  detail: number;
}

export class PagePicture {
  private readonly gl: WebGL2RenderingContext;
  private readonly objectProgram: Program;
  /** The same, with colours found at vertices. */
  private readonly roughProgram: Program;
  private readonly skyProgram: Program;
  private readonly meshes: UploadedMesh[];
  private readonly sheets = new Map<PageLight, WebGLTexture>();
  private light: PageLight;
  private worn = 0;

  /** Throws where the browser has no WebGL 2. */
  constructor(
    readonly canvas: HTMLCanvasElement,
    object: PageObject,
  ) {
    const gl = canvas.getContext('webgl2', { antialias: false, alpha: true, powerPreference: 'high-performance' });
    if (!gl) throw new Error('This browser offers no WebGL 2, which this page draws with.');
    this.gl = gl;
    this.objectProgram = new Program(gl, objectVertex(object.roughnessLevels, false), objectFragment(object.roughnessLevels));
    this.roughProgram = new Program(gl, objectVertex(object.roughnessLevels, true), SHADED_FRAGMENT);
    this.skyProgram = new Program(gl, SKY_VERTEX, skyFragment(object.roughnessLevels.length));
    this.meshes = object.meshes.map((mesh) => uploadMesh(gl, mesh));
    gl.activeTexture(gl.TEXTURE1);
    uploadFactors(gl, object);
    gl.activeTexture(gl.TEXTURE0);
    for (const { program, at } of [this.objectProgram, this.roughProgram]) {
      gl.useProgram(program);
      gl.uniform1i(at('factors'), 1);
    }
    this.light = object.lights[0]!;
    this.chooseLight(this.light);
  }

  chooseLight(light: PageLight): void {
    const { gl } = this;
    let sheet = this.sheets.get(light);
    if (!sheet) this.sheets.set(light, (sheet = uploadLight(gl, light)));
    gl.bindTexture(gl.TEXTURE_2D, sheet);
    this.light = light;
  }

  /** By its number among the object's materials. */
  chooseMaterial(number: number): void {
    if (number === this.worn) return;
    const { gl } = this;
    for (const { mesh, buffer } of this.meshes) {
      wear(mesh, number);
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.bufferSubData(gl.ARRAY_BUFFER, 0, mesh.vertices);
    }
    this.worn = number;
  }

  /** [device pixels] */
  resize(width: number, height: number): void {
    if (this.canvas.width !== width) this.canvas.width = width;
    if (this.canvas.height !== height) this.canvas.height = height;
  }

  draw({ view, rotation, exposureStops, material, sky, detail }: PageFrame): void {
    const { gl } = this;
    const { mesh, vertices } = this.meshes[detail]!;
    const angle = (rotation * Math.PI) / 180;
    const lightFromWorld = [Math.cos(angle), -Math.sin(angle), Math.sin(angle), Math.cos(angle)]; // by columns: turns back
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    if (mesh.closed) gl.enable(gl.CULL_FACE);
    else gl.disable(gl.CULL_FACE);
    gl.depthFunc(gl.LEQUAL);
    const { program, at } = detail === 0 ? this.objectProgram : this.roughProgram;
    gl.useProgram(program);
    gl.uniformMatrix4fv(at('clipFromWorld'), false, view.clipFromWorld);
    gl.uniform3fv(at('eye'), view.eye);
    gl.uniform3fv(at('low'), mesh.low);
    gl.uniform1f(at('placeStep'), mesh.placeStep);
    gl.uniform1f(at('normalStep'), 2 / (mesh.normalSteps - 1));
    gl.uniform1f(at('transferLow'), mesh.transferLow);
    gl.uniform1f(at('transferStep'), mesh.transferStep);
    gl.uniform3fv(at('harmonics'), turnHarmonics(this.light.harmonics, rotation).flat());
    gl.uniform3fv(at('tint'), material.tint);
    gl.uniform4fv(at('paint'), material.albedo ? [...material.albedo, 1] : [0, 0, 0, 0]);
    gl.uniform2fv(at('setRoughness'), share(material.roughness));
    gl.uniform2fv(at('setMetallic'), share(material.metallic));
    gl.uniformMatrix2fv(at('lightFromWorld'), false, lightFromWorld);
    gl.uniform1f(at('exposure'), 2 ** exposureStops);
    gl.bindVertexArray(vertices);
    gl.drawElements(gl.TRIANGLES, mesh.corners.length, gl.UNSIGNED_INT, 0);
    if (sky) this.drawSky(view, lightFromWorld, exposureStops);
  }

  /** Behind the object: only where nothing was drawn. */
  private drawSky(view: View, lightFromWorld: number[], exposureStops: number): void {
    const { gl } = this;
    const { program, at } = this.skyProgram;
    gl.useProgram(program);
    gl.disable(gl.CULL_FACE);
    gl.uniformMatrix4fv(at('worldFromClip'), false, view.worldFromClip);
    gl.uniform3fv(at('eye'), view.eye);
    gl.uniformMatrix2fv(at('lightFromWorld'), false, lightFromWorld);
    gl.uniform1f(at('level'), SKY_LEVEL);
    gl.uniform1f(at('exposure'), 2 ** exposureStops);
    gl.bindVertexArray(null);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }
}

const share = (value: number | null) => (value === null ? [0, 0] : [value, 1]);

class Program {
  readonly program: WebGLProgram;
  private readonly places = new Map<string, WebGLUniformLocation | null>();

  constructor(
    private readonly gl: WebGL2RenderingContext,
    vertex: string,
    fragment: string,
  ) {
    this.program = gl.createProgram();
    for (const [kind, source] of [
      [gl.VERTEX_SHADER, vertex],
      [gl.FRAGMENT_SHADER, fragment],
    ] as const) {
      const shader = gl.createShader(kind)!;
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(this.program, shader);
    }
    gl.linkProgram(this.program);
    if (gl.getProgramParameter(this.program, gl.LINK_STATUS) || gl.isContextLost()) return;
    const said = (gl.getAttachedShaders(this.program) ?? []).map((shader) => gl.getShaderInfoLog(shader)).join(' ');
    throw new Error(`The graphics driver refused a shader: ${said} ${gl.getProgramInfoLog(this.program)}`);
  }

  /** Of a uniform. */
  readonly at = (name: string): WebGLUniformLocation | null => {
    if (!this.places.has(name)) this.places.set(name, this.gl.getUniformLocation(this.program, name));
    return this.places.get(name)!;
  };
}

interface UploadedMesh {
  mesh: PageMesh;
  vertices: WebGLVertexArrayObject;
  /** Of them. */
  buffer: WebGLBuffer;
}

function uploadMesh(gl: WebGL2RenderingContext, mesh: PageMesh): UploadedMesh {
  const { vertices, corners } = mesh;
  const array = gl.createVertexArray();
  const buffer = gl.createBuffer();
  gl.bindVertexArray(array);
  gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
  gl.bufferData(gl.ARRAY_BUFFER, vertices, gl.STATIC_DRAW);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
  let offset = 0;
  [3, 2, 3, 3, 3, 4, 1].forEach((width, location) => {
    const narrow = location > 4;
    gl.enableVertexAttribArray(location);
    gl.vertexAttribPointer(location, width, narrow ? gl.UNSIGNED_BYTE : gl.UNSIGNED_SHORT, narrow, VERTEX_BYTES, offset);
    offset += narrow ? width : 2 * width;
  });
  gl.bindVertexArray(null);
  return { mesh, vertices: array, buffer };
}

function uploadLight(gl: WebGL2RenderingContext, { tables }: PageLight): WebGLTexture {
  const texture = makeTexture(gl);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA16F, SHEET_WIDTH, sheetHeight(tables.length), 0, gl.RGBA, gl.FLOAT, lightSheet(tables));
  return texture;
}

function uploadFactors(gl: WebGL2RenderingContext, { factors, factorsSide }: PageObject): void {
  makeTexture(gl);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RG8, factorsSide, factorsSide, 0, gl.RG, gl.UNSIGNED_BYTE, factors);
}

/** Looked up between its texels, without smaller copies. */
function makeTexture(gl: WebGL2RenderingContext): WebGLTexture {
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.LINEAR);
  for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
  return texture;
}
