/**
 * The instant picture: the asset's mesh, lit by the environment through three.js, drawn while the traced frame is on its way.
 *
 * It shows no shadows and no inter-reflection; camera, vertex materials, exposure, tone curve and sRGB are those of the server's picture.
 * three.js looks environments up with y up, we have z up, and the light can turn. `lightFromWorld` therefore turns object and camera
 * together into the environment's own frame: one matrix to be right, instead of one convention per kind of environment map.
 */

import {
  ACESFilmicToneMapping,
  AgXToneMapping,
  BufferAttribute,
  DataTexture,
  EquirectangularReflectionMapping,
  FloatType,
  Group,
  LinearFilter,
  LinearToneMapping,
  Matrix4,
  Mesh,
  MeshBasicMaterial,
  NeutralToneMapping,
  PerspectiveCamera,
  PMREMGenerator,
  Raycaster,
  RepeatWrapping,
  RGBAFormat,
  Scene,
  SRGBColorSpace,
  Triangle,
  Vector2,
  Vector3,
  WebGLRenderer,
  type Texture,
  type WebGLCubeRenderTarget,
} from 'three';
import { EXRLoader } from 'three/examples/jsm/loaders/EXRLoader.js';
import { HDRLoader } from 'three/examples/jsm/loaders/HDRLoader.js';
import type { MaterialMean } from '../edit/material/apply_materials';
import { nearestVertex } from '../edit/material/select_vertices';
import type { RestMesh, VertexMaterials } from '../edit/mesh';
import type { Settings } from '../session/protocol.gen';
import type { Vec3 } from '../session/view';
import { blurEnvironment, BLURRED_HEIGHT } from './blur_environment';
import { coarseFaces, MOST_MOVING_FACES } from './coarse_faces';
import { lightTurn } from './camera/light_turn';
import { drawsInSoftware, filterEnvironment } from './filter_environment';
import { loadMesh, restGeometry } from './mesh_file';
import { drawEnvironment, drawMaterials, drawVariants } from './thumbnails';
import { makeVertexMaterial, type HighlightUniforms } from './vertex_material';

/** Of the mesh's edges: seen on black and on white. */
const EDGE_COLOUR = 0xf0a63c;
/** The server's curves: drgs/render/film/tonemap.py has these very formulas. `standard` is exposure, then clipping. */
const TONE_MAPPING = { standard: LinearToneMapping, filmic: ACESFilmicToneMapping, agx: AgXToneMapping, neutral: NeutralToneMapping } as const;

const lightFromYUp = new Matrix4().makeRotationX(-Math.PI / 2); // (x, y, z) -> (x, z, -y)

/** What is to be drawn, and how. */
export interface LocalFrame {
  /** World, z up. */
  camera: PerspectiveCamera;
  /** Distances from the camera [world units]. */
  near: number;
  far: number;
  /** `rotation` in degrees. */
  light: { rotation: number; intensity: number };
  /** Rows of the rotation of the camera before which the light is as its table has it, where it turns with the camera; null: it stands still. */
  lightCamera: readonly Vec3[] | null;
  settings: Pick<Required<Settings>, 'exposure_stops' | 'tone_curve' | 'background'>;
  /** Strength 0..1 of the selection's colour. */
  highlight: number;
  /** Draw the selection and the edges, and nothing else. */
  onlyHighlight: boolean;
  edges: boolean;
  /** Left of this share of the width the object is drawn as captured; null: nowhere. */
  splitAt: number | null;
  /** With few faces, for motion on machines that draw all too slowly. */
  coarse: boolean;
}

export class LocalPicture {
  private readonly renderer: WebGLRenderer;
  private readonly scene = new Scene();
  /** Holds the object in the light's frame. */
  private readonly root = new Group();
  private readonly eye = new PerspectiveCamera();
  private readonly uniforms: HighlightUniforms = { highlight: { value: 0 }, onlyHighlight: { value: 0 } };
  private readonly material = makeVertexMaterial(this.uniforms);
  private readonly edgeMaterial = new MeshBasicMaterial({ color: EDGE_COLOUR, wireframe: true, transparent: true, opacity: 0.6, toneMapped: false });
  private readonly pmrem: PMREMGenerator;
  private readonly software: boolean;
  private radiance: WebGLCubeRenderTarget | null = null;
  private sky: Texture | null = null;
  /** The sky out of focus; made when it is first asked for. */
  private softSky: Texture | null = null;
  private object: Mesh | null = null;
  private edges: Mesh | null = null;
  /** The mesh with shape and materials as captured; made when it is first asked for. */
  private captured: Mesh | null = null;
  private rest: RestMesh | null = null;
  private fine: BufferAttribute | null = null;
  /** Fewer faces for motion; made when they are first asked for. */
  private coarse: BufferAttribute | null = null;

  /** Throws where the browser has no WebGL 2. */
  constructor(canvas: HTMLCanvasElement) {
    this.renderer = new WebGLRenderer({ canvas, antialias: true, alpha: true, powerPreference: 'low-power' });
    this.renderer.outputColorSpace = SRGBColorSpace;
    this.pmrem = new PMREMGenerator(this.renderer);
    this.software = drawsInSoftware(this.renderer);
    this.root.matrixAutoUpdate = false;
    this.eye.matrixAutoUpdate = false;
    this.scene.add(this.root);
  }

  resize(width: number, height: number, pixelRatio: number): void {
    if (this.renderer.getPixelRatio() !== pixelRatio) this.renderer.setPixelRatio(pixelRatio);
    this.renderer.setSize(width, height, false);
  }

  // ---- the object --------------------------------------------------------------------------------------------------------

  /** True once there is a mesh to draw. */
  get hasMesh(): boolean {
    return this.object !== null;
  }

  dropMesh(): void {
    this.object?.geometry.dispose();
    this.captured?.geometry.dispose();
    this.root.clear();
    this.object = this.captured = this.edges = this.rest = this.fine = this.coarse = null;
  }

  /** Replace the mesh by that of an asset. */
  async loadMesh(url: string): Promise<RestMesh> {
    const { geometry, rest } = await loadMesh(url);
    this.dropMesh();
    this.object = new Mesh(geometry, this.material);
    this.object.frustumCulled = false; // its shape changes; it is nearly always in sight
    this.edges = new Mesh(geometry, this.edgeMaterial);
    this.edges.frustumCulled = false;
    this.root.add(this.object, this.edges);
    this.rest = rest;
    this.fine = geometry.index;
    return rest;
  }

  /** Whether there is a coarser mesh to draw in motion. */
  get canBeCoarse(): boolean {
    return this.rest !== null && this.rest.faces.length > 3 * MOST_MOVING_FACES;
  }

  /** Draw few faces from now on, or all. */
  private drawFaces(coarse: boolean): void {
    const { object, rest } = this;
    if (!object || !rest) return;
    if (coarse) this.coarse ??= new BufferAttribute(coarseFaces(rest.positions, rest.faces), 1);
    const index = coarse ? this.coarse : this.fine;
    for (const mesh of [object, this.captured]) if (mesh && mesh.geometry.index !== index) mesh.geometry.setIndex(index);
  }

  setMaterials({ albedo, roughness, metallic }: VertexMaterials): void {
    this.write('color', albedo);
    this.write('_roughness', roughness);
    this.write('_metallic', metallic);
  }

  /** Weight 0..1 of each vertex in the selection's colour. */
  setHighlighted(weights: Float32Array): void {
    this.write('_weight', weights);
  }

  /** Vertex positions; the captured ones bring the captured normals back. */
  setShape(positions: Float32Array): void {
    const { object, rest } = this;
    if (!object || !rest) return;
    this.drawFaces(false);
    this.write('position', positions);
    if (positions === rest.positions) this.write('normal', rest.normals);
    else object.geometry.computeVertexNormals();
    object.geometry.boundingSphere = null;
  }

  private write(name: string, values: Float32Array): void {
    const attribute = this.object?.geometry.getAttribute(name) as BufferAttribute | undefined;
    if (!attribute || attribute.array.length !== values.length) return;
    (attribute.array as Float32Array).set(values);
    attribute.needsUpdate = true;
  }

  private capturedMesh(): Mesh | null {
    const { object, rest } = this;
    if (!object || !rest || this.captured) return this.captured;
    this.captured = new Mesh(restGeometry(rest, this.fine), this.material);
    this.captured.frustumCulled = false;
    this.root.add(this.captured);
    return this.captured;
  }

  /** Where the ray through a point of the picture (-1..1, y up) meets the object: the point at rest, and the nearest vertex. */
  pick(camera: PerspectiveCamera, x: number, y: number): { rest: Vec3; vertex: number } | null {
    const { object, rest } = this;
    if (!object || !rest) return null;
    this.drawFaces(false);
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
    const point = [0, 1, 2].map((axis) => corners.reduce((sum, i, k) => sum + share[k]! * rest.positions[3 * i + axis]!, 0)) as Vec3;
    return { rest: point, vertex: nearestVertex(rest.positions, point) };
  }

  // ---- the light ---------------------------------------------------------------------------------------------------------

  /** Fetch an EXR or HDR and light the scene with it. */
  async loadEnvironment(url: string, isHdr: boolean): Promise<void> {
    const loader = isHdr ? new HDRLoader() : new EXRLoader();
    this.showEnvironment(await loader.setDataType(FloatType).loadAsync(url));
  }

  /** Light from everywhere, where nothing else came: filtering any environment costs seconds where the browser draws without a GPU. */
  private ensureLight(): void {
    if (!this.scene.environment) this.showEnvironment(constantEnvironment());
  }

  private showEnvironment(sky: Texture): void {
    sky.mapping = EquirectangularReflectionMapping;
    sky.minFilter = sky.magFilter = LinearFilter;
    sky.generateMipmaps = false;
    const radiance = filterEnvironment(this.pmrem, sky, this.software);
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

  /** A colour is shown by the page behind the canvas: tone mapping would alter it here. */
  private backgroundOf({ onlyHighlight, settings: { background } }: LocalFrame): Texture | null {
    if (onlyHighlight) return null;
    return background === 'environment' ? this.sky : background === 'blurred' ? this.blurredSky() : null;
  }

  // ---- pictures ----------------------------------------------------------------------------------------------------------

  render(frame: LocalFrame): void {
    this.ensureLight();
    this.drawFaces(frame.coarse);
    const { camera, light, settings } = frame;
    this.uniforms.highlight.value = frame.highlight;
    this.uniforms.onlyHighlight.value = frame.onlyHighlight ? 1 : 0;
    if (this.edges) this.edges.visible = frame.edges;
    this.scene.background = this.backgroundOf(frame);
    const lightFromWorld = new Matrix4().makeRotationZ((-light.rotation * Math.PI) / 180);
    if (frame.lightCamera) lightFromWorld.premultiply(lightTurn(frame.lightCamera, camera.matrixWorld));
    lightFromWorld.premultiply(lightFromYUp);
    this.root.matrix.copy(lightFromWorld);
    this.root.matrixWorldNeedsUpdate = true;
    Object.assign(this.eye, { fov: camera.fov, aspect: camera.aspect, near: frame.near, far: frame.far });
    this.eye.updateProjectionMatrix();
    this.eye.matrix.multiplyMatrices(lightFromWorld, camera.matrixWorld);
    this.eye.matrixWorldNeedsUpdate = true;
    this.renderer.toneMapping = TONE_MAPPING[settings.tone_curve];
    this.renderer.toneMappingExposure = 2 ** settings.exposure_stops;
    this.scene.environmentIntensity = light.intensity;
    this.scene.backgroundIntensity = light.intensity;
    this.drawHalves(frame.splitAt);
  }

  private drawHalves(splitAt: number | null): void {
    const { renderer, object, edges } = this;
    const captured = splitAt === null ? this.captured : this.capturedMesh();
    if (captured) captured.visible = false;
    if (splitAt === null || !captured || !object || !edges) return renderer.render(this.scene, this.eye);
    const { x: width, y: height } = renderer.getSize(new Vector2());
    const line = Math.round(splitAt * width);
    renderer.setScissorTest(true);
    renderer.setScissor(line, 0, width - line, height);
    renderer.render(this.scene, this.eye);
    [object.visible, captured.visible, edges.visible] = [false, true, false];
    renderer.setScissor(0, 0, line, height);
    renderer.render(this.scene, this.eye);
    [object.visible, captured.visible] = [true, false];
    renderer.setScissorTest(false);
  }

  /** Pictures of materials under the present light. The canvas must be sized and drawn anew afterwards. */
  drawMaterials(materials: MaterialMean[], side: number): string[] {
    this.ensureLight();
    return drawMaterials(this.renderer, this.scene.environment, materials, side);
  }

  /** Pictures of the object in each of these materials, likewise. */
  drawVariants(worn: VertexMaterials[], side: number): string[] {
    if (!this.rest) return [];
    this.ensureLight();
    return drawVariants(this.renderer, this.scene.environment, this.rest, worn, side);
  }

  /** Picture of the present environment; null where its texels cannot be read. */
  drawEnvironment(width: number): string | null {
    return drawEnvironment(this.sky, width);
  }
}

/** Radiance 1 from everywhere: the light of an asset that was imported without any. */
function constantEnvironment(): DataTexture {
  const texture = new DataTexture(new Float32Array(4 * 2 * 4).fill(1), 4, 2, RGBAFormat, FloatType);
  texture.needsUpdate = true;
  return texture;
}
