/**
 * The instant picture: the asset's mesh, lit by the environment through three.js, drawn while the traced frame is on its way.
 *
 * It shows no shadows and no inter-reflection; everything else agrees with the server's picture: camera, vertex materials,
 * exposure, tone curve, sRGB. three.js looks environments up with y up, we have z up, and the light can turn: instead of
 * turning the environment, `lightFromWorld` turns object and camera together into the environment's own frame, which leaves one
 * matrix to be right instead of one convention per kind of environment map.
 */

import {
  ACESFilmicToneMapping,
  AgXToneMapping,
  BufferAttribute,
  BufferGeometry,
  Color,
  DataTexture,
  EquirectangularReflectionMapping,
  FloatType,
  Group,
  LinearFilter,
  LinearToneMapping,
  Matrix4,
  Mesh,
  MeshBasicMaterial,
  MeshStandardMaterial,
  NeutralToneMapping,
  PerspectiveCamera,
  PMREMGenerator,
  Raycaster,
  RepeatWrapping,
  RGBAFormat,
  Scene,
  SphereGeometry,
  SRGBColorSpace,
  Triangle,
  Vector2,
  Vector3,
  WebGLRenderer,
  type Texture,
  type WebGLRenderTarget,
} from 'three';
import { EXRLoader } from 'three/examples/jsm/loaders/EXRLoader.js';
import { GLTFLoader } from 'three/examples/jsm/loaders/GLTFLoader.js';
import { HDRLoader } from 'three/examples/jsm/loaders/HDRLoader.js';
import { blurEnvironment, BLURRED_HEIGHT } from './blur';
import { srgbFromLinear, type Triple } from './color';
import { nearestVertex, type MaterialMean, type Materials, type RestMesh } from './materials';
import type { Settings } from './protocol.gen';

type Background = Required<Settings>['background'];
type ToneCurve = Required<Settings>['tone_curve'];
/** The server's curves: drgs/render/tonemap.py has these very formulas. `standard` is exposure, then clipping. */
const TONE_MAPPING = { standard: LinearToneMapping, filmic: ACESFilmicToneMapping, agx: AgXToneMapping, neutral: NeutralToneMapping } as const;

const lightFromYUp = new Matrix4().makeRotationX(-Math.PI / 2); // (x, y, z) -> (x, z, -y)

export class LocalPicture {
  private readonly renderer: WebGLRenderer;
  private readonly scene = new Scene();
  private readonly root = new Group();
  private readonly eye = new PerspectiveCamera();
  private readonly material = new MeshStandardMaterial({ roughness: 1, metalness: 1 });
  private readonly wireMaterial = new MeshBasicMaterial({ color: EDGE_COLOUR, wireframe: true, transparent: true, opacity: 0.6, toneMapped: false });
  private wire: Mesh | null = null;
  private readonly pmrem: PMREMGenerator;
  private radiance: WebGLRenderTarget | null = null;
  private sky: Texture | null = null;
  /** The sky out of focus, once it was asked for. */
  private softSky: Texture | null = null;
  private background: Background = 'environment';
  private readonly uniforms = {
    /** Strength 0..1 of the selection's colour, and 1 where nothing else is to be drawn. */
    highlight: { value: 0 },
    onlyHighlight: { value: 0 },
  };
  private object: Mesh | null = null;
  /** The same mesh with shape and materials as captured; made when it is first asked for. */
  private captured: Mesh | null = null;
  private rest: RestMesh | null = null;

  /** Throws where the browser has no WebGL 2. */
  constructor(readonly canvas: HTMLCanvasElement) {
    this.renderer = new WebGLRenderer({ canvas, antialias: true, alpha: true, powerPreference: 'low-power' });
    this.renderer.outputColorSpace = SRGBColorSpace;
    this.pmrem = new PMREMGenerator(this.renderer);
    this.root.matrixAutoUpdate = false;
    this.eye.matrixAutoUpdate = false;
    this.scene.add(this.root);
    this.readVertexMaterials();
    this.showEnvironment(constantEnvironment());
  }

  resize(width: number, height: number, pixelRatio: number): void {
    if (this.renderer.getPixelRatio() !== pixelRatio) this.renderer.setPixelRatio(pixelRatio);
    this.renderer.setSize(width, height, false);
  }

  /** True once there is a mesh to draw. */
  get hasMesh(): boolean {
    return this.object !== null;
  }

  dropMesh(): void {
    this.object?.geometry.dispose();
    this.captured?.geometry.dispose();
    this.root.clear();
    this.object = this.captured = this.wire = this.rest = null;
  }

  /**
   * Replace the mesh by an asset's `mesh.glb`, whose buffers hold world units with z up; its node, which turns them for other
   * programs, is left out.
   */
  async loadMesh(url: string): Promise<RestMesh> {
    const gltf = await new GLTFLoader().loadAsync(url);
    const loaded = gltf.scene.getObjectByProperty('isMesh', true) as Mesh;
    const geometry = loaded.geometry as BufferGeometry;
    if (!geometry.getAttribute('normal')) geometry.computeVertexNormals();
    const count = completeVertexMaterials(geometry, loaded.material as MeshStandardMaterial);
    geometry.setAttribute('_weight', new BufferAttribute(new Float32Array(count), 1));
    const copy = (name: string) => (geometry.getAttribute(name).array as Float32Array).slice();
    // Attributes may share one buffer in the file (colour and albedo do): ours are written to.
    for (const name of ['position', 'normal', 'color', '_roughness', '_metallic']) geometry.setAttribute(name, new BufferAttribute(copy(name), geometry.getAttribute(name).itemSize));
    this.dropMesh();
    this.object = new Mesh(geometry, this.material);
    this.object.frustumCulled = false; // its shape changes; it is nearly always in sight
    this.wire = new Mesh(geometry, this.wireMaterial);
    this.wire.frustumCulled = this.wire.visible = false;
    this.root.add(this.object, this.wire);
    this.rest = {
      positions: copy('position'),
      normals: copy('normal'),
      faces: new Uint32Array(geometry.index!.array),
      materials: { albedo: copy('color'), roughness: copy('_roughness'), metallic: copy('_metallic') },
    };
    return this.rest;
  }

  /** Picture of the present environment, its median made middle grey, as a data address; null where its texels cannot be read. */
  drawSky(width: number): string | null {
    const { data, width: columns, height: rows } = (this.sky?.image ?? {}) as { data?: unknown; width: number; height: number };
    if (!(data instanceof Float32Array)) return null;
    const height = width / 2;
    const channels = data.length / (columns * rows);
    const texel = (x: number, y: number) => channels * (Math.floor(((y + 0.5) * rows) / height) * columns + Math.floor(((x + 0.5) * columns) / width));
    const flat = document.createElement('canvas');
    Object.assign(flat, { width, height });
    const context = flat.getContext('2d')!;
    const picture = context.createImageData(width, height);
    const order = Float32Array.from({ length: width * height }, (_, i) => data[texel(i % width, Math.floor(i / width)) + 1]!).sort();
    const scale = 0.18 / Math.max(1e-6, order[order.length >> 1]!);
    for (let i = 0; i < width * height; i++) {
      const from = texel(i % width, height - 1 - Math.floor(i / width)); // loaders store rows from below
      for (let k = 0; k < 3; k++) {
        const value = Math.max(0, data[from + k]!) * scale;
        picture.data[4 * i + k] = 255 * srgbFromLinear(value / (1 + value));
      }
      picture.data[4 * i + 3] = 255;
    }
    context.putImageData(picture, 0, 0);
    return flat.toDataURL('image/jpeg');
  }

  setMaterials({ albedo, roughness, metallic }: Materials): void {
    this.write('color', albedo);
    this.write('_roughness', roughness);
    this.write('_metallic', metallic);
  }

  /** Whether the edges that are not hidden are drawn over the object. */
  showEdges(on: boolean): void {
    if (this.wire) this.wire.visible = on;
  }

  setHighlighted(weights: Float32Array): void {
    this.write('_weight', weights);
  }

  /** Vertex positions; the captured ones bring the captured normals back. */
  setShape(positions: Float32Array): void {
    const { object, rest } = this;
    if (!object || !rest) return;
    this.write('position', positions);
    if (positions === rest.positions) this.write('normal', rest.normals);
    else object.geometry.computeVertexNormals();
    object.geometry.boundingSphere = null;
  }

  private capturedMesh(): Mesh | null {
    const { object, rest } = this;
    if (!object || !rest || this.captured) return this.captured;
    const geometry = new BufferGeometry().setIndex(object.geometry.index);
    const attributes = { position: rest.positions, normal: rest.normals, color: rest.materials.albedo, _roughness: rest.materials.roughness, _metallic: rest.materials.metallic };
    for (const [name, values] of Object.entries(attributes)) geometry.setAttribute(name, new BufferAttribute(values, (3 * values.length) / rest.positions.length));
    geometry.setAttribute('_weight', new BufferAttribute(new Float32Array(rest.positions.length / 3), 1));
    this.captured = new Mesh(geometry, this.material);
    this.captured.frustumCulled = false;
    this.root.add(this.captured);
    return this.captured;
  }

  private write(name: string, values: Float32Array): void {
    const attribute = this.object?.geometry.getAttribute(name) as BufferAttribute | undefined;
    if (!attribute || attribute.array.length !== values.length) return;
    (attribute.array as Float32Array).set(values);
    attribute.needsUpdate = true;
  }

  /** Where the ray through a point of the picture (-1..1, y up) meets the object: at rest, and as posed. */
  pick(camera: PerspectiveCamera, x: number, y: number): { rest: Triple; posed: Triple; vertex: number } | null {
    const { object, rest } = this;
    if (!object || !rest) return null;
    const ray = new Raycaster();
    camera.updateMatrixWorld();
    ray.setFromCamera(new Vector2(x, y), camera);
    object.matrixWorld.identity(); // the picture's own frame turns with the light; rays are in the world's
    const [hit] = ray.intersectObject(object, false);
    if (!hit?.face) return null;
    const corners = [hit.face.a, hit.face.b, hit.face.c];
    const positions = object.geometry.getAttribute('position');
    const posed = corners.map((i) => new Vector3().fromBufferAttribute(positions, i)) as [Vector3, Vector3, Vector3];
    const share = Triangle.getBarycoord(hit.point, ...posed, new Vector3())!.toArray();
    const point = [0, 1, 2].map((axis) => corners.reduce((sum, i, k) => sum + share[k]! * rest.positions[3 * i + axis]!, 0)) as Triple;
    return { rest: point, posed: hit.point.toArray(), vertex: nearestVertex(rest.positions, point) };
  }

  /** Pictures of a ball of each material under the present light, as data addresses. The canvas must be drawn anew afterwards. */
  drawBalls(materials: MaterialMean[], side: number): string[] {
    const scene = new Scene();
    scene.environment = this.scene.environment;
    const ball = new Mesh(new SphereGeometry(1, 32, 24));
    const eye = new PerspectiveCamera(30, 1, 0.1, 10);
    eye.position.set(0, 0.6, 4);
    eye.lookAt(0, 0, 0);
    scene.add(ball);
    this.resize(side, side, 1);
    this.renderer.toneMapping = LinearToneMapping;
    this.renderer.toneMappingExposure = 1;
    const flat = document.createElement('canvas');
    flat.width = flat.height = side;
    const context = flat.getContext('2d')!;
    const pictures = materials.map(({ albedo, roughness, metallic }) => {
      ball.material = new MeshStandardMaterial({ color: new Color().setRGB(...albedo), roughness, metalness: metallic });
      this.renderer.render(scene, eye);
      context.clearRect(0, 0, side, side);
      context.drawImage(this.canvas, 0, 0);
      ball.material.dispose();
      return flat.toDataURL();
    });
    ball.geometry.dispose();
    return pictures;
  }

  /** Fetch an EXR or HDR and light the scene with it. */
  async loadEnvironment(url: string, isHdr: boolean): Promise<void> {
    const loader = isHdr ? new HDRLoader() : new EXRLoader();
    this.showEnvironment(await loader.setDataType(FloatType).loadAsync(url));
  }

  setBackground(background: Background): void {
    // A colour is shown by the page behind the canvas: tone mapping would alter it here.
    this.background = background;
  }

  /** Draw what `camera` sees (world, z up); left of the share `split` of the width as captured. */
  render(camera: PerspectiveCamera, near: number, far: number, rotationDegrees: number, intensity: number, stops: number, curve: ToneCurve, highlight: number, onlyHighlight: boolean, split: number | null = null): void {
    this.uniforms.highlight.value = highlight;
    this.uniforms.onlyHighlight.value = onlyHighlight ? 1 : 0;
    this.scene.background = onlyHighlight ? null : this.background === 'environment' ? this.sky : this.background === 'blurred' ? this.blurredSky() : null;
    const lightFromWorld = new Matrix4().makeRotationZ((-rotationDegrees * Math.PI) / 180).premultiply(lightFromYUp);
    this.root.matrix.copy(lightFromWorld);
    this.root.matrixWorldNeedsUpdate = true;
    this.eye.fov = camera.fov;
    this.eye.aspect = camera.aspect;
    this.eye.near = near;
    this.eye.far = far;
    this.eye.updateProjectionMatrix();
    this.eye.matrix.multiplyMatrices(lightFromWorld, camera.matrixWorld);
    this.eye.matrixWorldNeedsUpdate = true;
    this.renderer.toneMapping = TONE_MAPPING[curve];
    this.renderer.toneMappingExposure = 2 ** stops;
    this.scene.environmentIntensity = intensity;
    this.scene.backgroundIntensity = intensity;
    this.drawHalves(split);
  }

  private drawHalves(split: number | null): void {
    const { renderer, object, wire } = this;
    const captured = split === null ? this.captured : this.capturedMesh();
    if (captured) captured.visible = false;
    if (split === null || !captured || !object) return renderer.render(this.scene, this.eye);
    const { x: width, y: height } = renderer.getSize(new Vector2());
    const line = Math.round(split * width);
    renderer.setScissorTest(true);
    renderer.setScissor(line, 0, width - line, height);
    renderer.render(this.scene, this.eye);
    const edges = wire?.visible ?? false;
    [object.visible, captured.visible] = [false, true];
    this.showEdges(false);
    renderer.setScissor(0, 0, line, height);
    renderer.render(this.scene, this.eye);
    [object.visible, captured.visible] = [true, false];
    this.showEdges(edges);
    renderer.setScissorTest(false);
  }

  dispose(): void {
    this.radiance?.dispose();
    this.sky?.dispose();
    this.softSky?.dispose();
    this.pmrem.dispose();
    this.renderer.dispose();
  }

  private showEnvironment(sky: Texture): void {
    sky.mapping = EquirectangularReflectionMapping;
    sky.minFilter = sky.magFilter = LinearFilter;
    sky.generateMipmaps = false;
    const radiance = this.pmrem.fromEquirectangular(sky);
    this.radiance?.dispose();
    this.sky?.dispose();
    this.softSky?.dispose();
    this.radiance = radiance;
    this.sky = sky;
    this.softSky = null;
    this.scene.environment = radiance.texture;
  }

  private blurredSky(): Texture | null {
    const { data, width, height } = (this.sky?.image ?? {}) as { data?: unknown; width: number; height: number };
    if (this.softSky || !(data instanceof Float32Array)) return this.softSky ?? this.sky;
    const soft = new DataTexture(blurEnvironment(data, width, height), 2 * BLURRED_HEIGHT, BLURRED_HEIGHT, RGBAFormat, FloatType);
    soft.mapping = EquirectangularReflectionMapping;
    soft.wrapS = RepeatWrapping;
    soft.minFilter = soft.magFilter = LinearFilter;
    soft.needsUpdate = true;
    this.softSky = soft;
    return soft;
  }

  /** Teach the standard material to take roughness and metallic from vertices, as the asset's mesh holds them. */
  private readVertexMaterials(): void {
    this.material.vertexColors = true;
    this.material.polygonOffset = true; // edges that lie in the surface win
    this.material.polygonOffsetFactor = this.material.polygonOffsetUnits = 1;
    this.material.onBeforeCompile = (shader) => {
      Object.assign(shader.uniforms, this.uniforms);
      shader.vertexShader = shader.vertexShader
        .replace('#include <common>', '#include <common>\nattribute float _roughness, _metallic, _weight;\nvarying vec3 vRoughnessMetallicWeight;')
        .replace('#include <begin_vertex>', '#include <begin_vertex>\nvRoughnessMetallicWeight = vec3(_roughness, _metallic, _weight);');
      shader.fragmentShader = shader.fragmentShader
        .replace('#include <common>', '#include <common>\nvarying vec3 vRoughnessMetallicWeight;\nuniform float highlight, onlyHighlight;')
        .replace('#include <roughnessmap_fragment>', 'float roughnessFactor = vRoughnessMetallicWeight.x;')
        .replace('#include <metalnessmap_fragment>', 'float metalnessFactor = vRoughnessMetallicWeight.y;')
        // Colours here are sRGB with premultiplied alpha.
        .replace(
          '#include <dithering_fragment>',
          `float marked = highlight * vRoughnessMetallicWeight.z;
          gl_FragColor = mix(gl_FragColor * (1.0 - onlyHighlight), vec4(${HIGHLIGHT}, 1.0), marked);`,
        );
    };
  }
}

/** Fill in what a foreign file leaves out, so that one shader serves all; returns the number of vertices. */
function completeVertexMaterials(geometry: BufferGeometry, authored: MeshStandardMaterial): number {
  const count = geometry.getAttribute('position').count;
  const fill = (name: string, values: number[]) => {
    if (geometry.getAttribute(name)) return;
    const array = Float32Array.from({ length: count * values.length }, (_, i) => values[i % values.length]!);
    geometry.setAttribute(name, new BufferAttribute(array, values.length));
  };
  const { r, g, b } = authored.color ?? new Color(0.5, 0.5, 0.5);
  fill('color', [r, g, b]);
  fill('_roughness', [authored.roughness ?? 0.5]);
  fill('_metallic', [authored.metalness ?? 0]);
  return count;
}

/** Of the mesh's edges: seen on black and on white. */
const EDGE_COLOUR = 0xf0a63c;
/** Of selected parts, as GLSL: a blue that few captured things have. */
const HIGHLIGHT = 'vec3(0.1, 0.65, 1.0)';

/** Radiance 1 from everywhere: the light of an asset that was imported without any. */
function constantEnvironment(): DataTexture {
  const texture = new DataTexture(new Float32Array(4 * 2 * 4).fill(1), 4, 2, RGBAFormat, FloatType);
  texture.needsUpdate = true;
  return texture;
}
