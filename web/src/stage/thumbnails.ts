/** Small pictures for the panels: balls of materials and the object in its variants under the present light, and the environment itself. All are data addresses. */

import { BufferAttribute, LinearToneMapping, Mesh, MeshStandardMaterial, PerspectiveCamera, Scene, SphereGeometry, Vector3, type BufferGeometry, type Texture, type WebGLRenderer } from 'three';
import type { MaterialMean } from '../edit/material/apply_materials';
import { luminance, srgbFromLinear } from '../edit/material/color';
import type { RestMesh, VertexMaterials } from '../edit/mesh';
import { MIDDLE_GREY } from '../session/constants.gen';
import { restGeometry } from './mesh_file';
import { makeVertexMaterial } from './vertex_material';

/** Towards the camera of an object's picture, y up: as that of the library's (worker/drgs_worker/jobs/start_view.py). */
const FRONT = new Vector3(0.55, 0.45, 0.75).normalize();
const FOV_DEGREES = 30;

/** Drawn on the renderer's canvas, which must be sized and drawn anew afterwards. `side` in pixels. */
export function drawMaterials(renderer: WebGLRenderer, environment: Texture | null, materials: MaterialMean[], side: number): string[] {
  const ball = new Mesh(new SphereGeometry(1, 32, 24), new MeshStandardMaterial());
  const eye = new PerspectiveCamera(FOV_DEGREES, 1, 0.1, 10);
  eye.position.set(0, 0.6, 4);
  eye.lookAt(0, 0, 0);
  return drawEach(renderer, environment, ball, eye, side, materials, ({ albedo, roughness, metallic }) => {
    ball.material.color.setRGB(...albedo);
    Object.assign(ball.material, { roughness, metalness: metallic });
  });
}

/** The object itself in each of these materials, likewise. */
export function drawVariants(renderer: WebGLRenderer, environment: Texture | null, rest: RestMesh, worn: VertexMaterials[], side: number): string[] {
  const geometry = restGeometry(rest, new BufferAttribute(rest.faces, 1));
  const object = new Mesh(geometry, makeVertexMaterial({ highlight: { value: 0 }, onlyHighlight: { value: 0 } }));
  object.rotation.x = -Math.PI / 2; // z up to y up, as environments are looked up
  geometry.computeBoundingSphere();
  const { center, radius } = geometry.boundingSphere!;
  const middle = center.clone().applyEuler(object.rotation);
  const distance = radius / Math.sin((FOV_DEGREES * Math.PI) / 360);
  const eye = new PerspectiveCamera(FOV_DEGREES, 1, distance - 1.1 * radius, distance + 1.1 * radius);
  eye.position.copy(FRONT).multiplyScalar(distance).add(middle);
  eye.lookAt(middle);
  return drawEach(renderer, environment, object, eye, side, worn, ({ albedo, roughness, metallic }) => {
    // Other arrays, not other values: those of `rest` and of the variants are not ours to write to.
    for (const [name, array] of Object.entries({ color: albedo, _roughness: roughness, _metallic: metallic })) Object.assign(geometry.getAttribute(name), { array, needsUpdate: true });
  });
}

/** A picture of `shown` for each of `kinds`, once `wear` has put it on. What is shown is disposed of. */
function drawEach<Kind>(
  renderer: WebGLRenderer,
  environment: Texture | null,
  shown: Mesh<BufferGeometry, MeshStandardMaterial>,
  eye: PerspectiveCamera,
  side: number,
  kinds: Kind[],
  wear: (kind: Kind) => void,
): string[] {
  const scene = new Scene();
  scene.environment = environment;
  scene.add(shown);
  renderer.setPixelRatio(1);
  renderer.setSize(side, side, false);
  renderer.toneMapping = LinearToneMapping;
  renderer.toneMappingExposure = 1;
  const flat = document.createElement('canvas');
  flat.width = flat.height = side;
  const context = flat.getContext('2d')!;
  const pictures = kinds.map((kind) => {
    wear(kind);
    renderer.render(scene, eye);
    context.clearRect(0, 0, side, side);
    context.drawImage(renderer.domElement, 0, 0);
    return flat.toDataURL();
  });
  shown.material.dispose();
  shown.geometry.dispose();
  return pictures;
}

/** A lat-long environment, twice as wide as high, its median luminance made middle grey; null where its texels cannot be read. */
export function drawEnvironment(sky: Texture | null, width: number): string | null {
  const { data, width: columns, height: rows } = (sky?.image ?? {}) as { data?: unknown; width: number; height: number };
  if (!(data instanceof Float32Array)) return null;
  const height = width / 2;
  const channels = data.length / (columns * rows);
  const texel = (x: number, y: number) => channels * (Math.floor(((y + 0.5) * rows) / height) * columns + Math.floor(((x + 0.5) * columns) / width));
  const flat = document.createElement('canvas');
  Object.assign(flat, { width, height });
  const context = flat.getContext('2d')!;
  const picture = context.createImageData(width, height);
  const brightness = (at: number) => luminance(data[at]!, data[at + 1]!, data[at + 2]!);
  const sorted = Float32Array.from({ length: width * height }, (_, i) => brightness(texel(i % width, Math.floor(i / width)))).sort();
  const scale = MIDDLE_GREY / Math.max(1e-6, sorted[sorted.length >> 1]!);
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
