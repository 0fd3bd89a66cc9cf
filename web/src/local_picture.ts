/**
 * The instant picture: the asset's mesh, lit by the environment through three.js, drawn while the traced frame is on its way.
 *
 * It shows no shadows and no inter-reflection; everything else agrees with the server's picture: camera, vertex materials,
 * exposure, sRGB curve with clipping. three.js looks environments up with y up, we have z up, and the light can turn: instead of
 * turning the environment, `lightFromWorld` turns object and camera together into the environment's own frame, which leaves one
 * matrix to be right instead of one convention per kind of environment map.
 */

import {
  BufferAttribute,
  Color,
  DataTexture,
  EquirectangularReflectionMapping,
  FloatType,
  Group,
  LinearFilter,
  LinearToneMapping,
  Matrix4,
  Mesh,
  MeshStandardMaterial,
  PerspectiveCamera,
  PMREMGenerator,
  RGBAFormat,
  Scene,
  SRGBColorSpace,
  Vector2,
  Vector3,
  WebGLRenderer,
  type BufferGeometry,
  type Texture,
  type WebGLRenderTarget,
} from 'three';
import { EXRLoader } from 'three/examples/jsm/loaders/EXRLoader.js';
import { GLTFLoader } from 'three/examples/jsm/loaders/GLTFLoader.js';
import { HDRLoader } from 'three/examples/jsm/loaders/HDRLoader.js';
import type { Triple } from './color';
import type { MaterialOverride } from './edit_log';

const lightFromYUp = new Matrix4().makeRotationX(-Math.PI / 2); // (x, y, z) -> (x, z, -y)

export interface MaterialMean {
  albedo: Triple;
  roughness: number;
  metallic: number;
}

export class LocalPicture {
  private readonly renderer: WebGLRenderer;
  private readonly scene = new Scene();
  private readonly root = new Group();
  private readonly eye = new PerspectiveCamera();
  private readonly material = new MeshStandardMaterial({ roughness: 1, metalness: 1 });
  private readonly pmrem: PMREMGenerator;
  private radiance: WebGLRenderTarget | null = null;
  private sky: Texture | null = null;
  private background: 'environment' | 'transparent' | Triple = 'environment';
  private readonly uniforms = {
    albedoOverride: { value: new Color() },
    albedoScale: { value: new Color(1, 1, 1) },
    roughnessMetallicOverride: { value: new Vector2() },
    roughnessMetallicScale: { value: new Vector2(1, 1) },
    /** 1 where the override replaces the captured value: albedo, roughness, metallic. */
    overridden: { value: new Vector3() },
  };
  /** True once there is a mesh to draw. */
  hasMesh = false;

  /** Throws where the browser has no WebGL 2. */
  constructor(readonly canvas: HTMLCanvasElement) {
    this.renderer = new WebGLRenderer({ canvas, antialias: true, alpha: true, powerPreference: 'low-power' });
    this.renderer.outputColorSpace = SRGBColorSpace;
    this.renderer.toneMapping = LinearToneMapping; // exposure, then clipping: what the server does
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

  /**
   * Replace the mesh by an asset's `mesh.glb`, whose buffers hold world units with z up; its node, which turns them for other
   * programs, is left out. Returns the mean of its vertex materials, which the sliders show while nothing is overridden.
   */
  async loadMesh(url: string): Promise<MaterialMean> {
    const gltf = await new GLTFLoader().loadAsync(url);
    this.root.traverse((node) => node instanceof Mesh && (node.geometry as BufferGeometry).dispose());
    this.root.clear();
    const means: MaterialMean[] = [];
    gltf.scene.traverse((node) => {
      if (!(node instanceof Mesh)) return;
      const geometry = node.geometry as BufferGeometry;
      const authored = node.material as MeshStandardMaterial;
      if (!geometry.getAttribute('normal')) geometry.computeVertexNormals();
      means.push(completeVertexMaterials(geometry, authored));
      const mesh = new Mesh(geometry, this.material);
      this.root.add(mesh);
    });
    this.hasMesh = means.length > 0;
    return means[0] ?? { albedo: [0.5, 0.5, 0.5], roughness: 0.5, metallic: 0 };
  }

  /** Fetch an EXR or HDR and light the scene with it. */
  async loadEnvironment(url: string, isHdr: boolean): Promise<void> {
    const loader = isHdr ? new HDRLoader() : new EXRLoader();
    this.showEnvironment(await loader.setDataType(FloatType).loadAsync(url));
  }

  setMaterial(override: MaterialOverride): void {
    const { albedo, roughness, metallic } = override;
    const u = this.uniforms;
    if (albedo.value) u.albedoOverride.value.setRGB(...albedo.value);
    u.roughnessMetallicOverride.value.set(roughness.value ?? 0, metallic.value ?? 0);
    u.overridden.value.set(albedo.value ? 1 : 0, roughness.value === null ? 0 : 1, metallic.value === null ? 0 : 1);
    u.albedoScale.value.setRGB(...albedo.factor);
    u.roughnessMetallicScale.value.set(roughness.factor, metallic.factor);
  }

  setBackground(background: 'environment' | 'transparent' | Triple): void {
    this.background = background;
    this.applyBackground();
  }

  /** Draw what `camera` sees (world, z up). */
  render(camera: PerspectiveCamera, near: number, far: number, rotationDegrees: number, intensity: number, stops: number): void {
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
    this.renderer.toneMappingExposure = 2 ** stops;
    this.scene.environmentIntensity = intensity;
    this.scene.backgroundIntensity = intensity;
    this.renderer.render(this.scene, this.eye);
  }

  dispose(): void {
    this.radiance?.dispose();
    this.sky?.dispose();
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
    this.radiance = radiance;
    this.sky = sky;
    this.scene.environment = radiance.texture;
    this.applyBackground();
  }

  private applyBackground(): void {
    if (this.background === 'environment') this.scene.background = this.sky;
    else this.scene.background = null;
    // A colour is shown by the page behind the canvas: tone mapping would alter it here.
  }

  /** Teach the standard material to take roughness and metallic from vertices, as the asset's mesh holds them. */
  private readVertexMaterials(): void {
    this.material.vertexColors = true;
    this.material.onBeforeCompile = (shader) => {
      Object.assign(shader.uniforms, this.uniforms);
      shader.vertexShader = shader.vertexShader
        .replace('#include <common>', '#include <common>\nattribute float _roughness;\nattribute float _metallic;\nvarying vec2 vRoughnessMetallic;')
        .replace('#include <begin_vertex>', '#include <begin_vertex>\nvRoughnessMetallic = vec2(_roughness, _metallic);');
      shader.fragmentShader = shader.fragmentShader
        .replace(
          '#include <common>',
          `#include <common>
          varying vec2 vRoughnessMetallic;
          uniform vec3 albedoOverride, albedoScale, overridden;
          uniform vec2 roughnessMetallicOverride, roughnessMetallicScale;`,
        )
        .replace('#include <color_fragment>', 'diffuseColor.rgb = clamp(mix(vColor.rgb, albedoOverride, overridden.x) * albedoScale, 0.0, 1.0);')
        .replace(
          '#include <roughnessmap_fragment>',
          `vec2 roughnessMetallic = clamp(mix(vRoughnessMetallic, roughnessMetallicOverride, overridden.yz) * roughnessMetallicScale, 0.0, 1.0);
          float roughnessFactor = roughnessMetallic.x;`,
        )
        .replace('#include <metalnessmap_fragment>', 'float metalnessFactor = roughnessMetallic.y;');
    };
  }
}

/** Fill in what a foreign file leaves out, so that one shader serves all; returns the mean over the vertices. */
function completeVertexMaterials(geometry: BufferGeometry, authored: MeshStandardMaterial): MaterialMean {
  const count = geometry.getAttribute('position').count;
  const constant = (value: number) => new BufferAttribute(new Float32Array(count).fill(value), 1);
  if (!geometry.getAttribute('color')) {
    const { r, g, b } = authored.color ?? new Color(0.5, 0.5, 0.5);
    geometry.setAttribute('color', new BufferAttribute(new Float32Array(Array.from({ length: count }, () => [r, g, b]).flat()), 3));
  }
  if (!geometry.getAttribute('_roughness')) geometry.setAttribute('_roughness', constant(authored.roughness ?? 0.5));
  if (!geometry.getAttribute('_metallic')) geometry.setAttribute('_metallic', constant(authored.metalness ?? 0));
  const mean = (name: string, component: 'getX' | 'getY' | 'getZ') => {
    const attribute = geometry.getAttribute(name);
    let sum = 0;
    for (let i = 0; i < count; i++) sum += attribute[component](i);
    return sum / Math.max(1, count);
  };
  return { albedo: [mean('color', 'getX'), mean('color', 'getY'), mean('color', 'getZ')], roughness: mean('_roughness', 'getX'), metallic: mean('_metallic', 'getX') };
}

/** Radiance 1 from everywhere: the light of an asset that was imported without any. */
function constantEnvironment(): DataTexture {
  const texture = new DataTexture(new Float32Array(4 * 2 * 4).fill(1), 4, 2, RGBAFormat, FloatType);
  texture.needsUpdate = true;
  return texture;
}
