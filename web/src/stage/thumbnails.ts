/** Small pictures for the panels: materials as materialThumbnails under the present light, and the environment itself. All are data addresses. */

import { Color, LinearToneMapping, Mesh, MeshStandardMaterial, PerspectiveCamera, Scene, SphereGeometry, type Texture, type WebGLRenderer } from 'three';
import type { MaterialMean } from '../edit/material/apply_materials';
import { luminance, srgbFromLinear } from '../edit/material/color';
import { MIDDLE_GREY } from '../session/constants.gen';

/** Drawn on the renderer's canvas, which must be sized and drawn anew afterwards. `side` in pixels. */
export function drawMaterials(renderer: WebGLRenderer, environment: Texture | null, materials: MaterialMean[], side: number): string[] {
  const scene = new Scene();
  scene.environment = environment;
  const ball = new Mesh(new SphereGeometry(1, 32, 24));
  const eye = new PerspectiveCamera(30, 1, 0.1, 10);
  eye.position.set(0, 0.6, 4);
  eye.lookAt(0, 0, 0);
  scene.add(ball);
  renderer.setPixelRatio(1);
  renderer.setSize(side, side, false);
  renderer.toneMapping = LinearToneMapping;
  renderer.toneMappingExposure = 1;
  const flat = document.createElement('canvas');
  flat.width = flat.height = side;
  const context = flat.getContext('2d')!;
  const pictures = materials.map(({ albedo, roughness, metallic }) => {
    ball.material = new MeshStandardMaterial({ color: new Color().setRGB(...albedo), roughness, metalness: metallic });
    renderer.render(scene, eye);
    context.clearRect(0, 0, side, side);
    context.drawImage(renderer.domElement, 0, 0);
    ball.material.dispose();
    return flat.toDataURL();
  });
  ball.geometry.dispose();
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
