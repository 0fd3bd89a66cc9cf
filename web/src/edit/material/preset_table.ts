/** VertexMaterials that everybody wants. Albedo is linear; that of metals is their reflectance at normal incidence in Rec.709. */

import type { MaterialMean } from './apply_materials';

export interface NamedMaterial extends MaterialMean {
  name: string;
}

export const PRESETS: NamedMaterial[] = [
  { name: 'Gold', albedo: [1.0, 0.766, 0.336], roughness: 0.2, metallic: 1 },
  { name: 'Copper', albedo: [0.955, 0.637, 0.538], roughness: 0.25, metallic: 1 },
  { name: 'Chrome', albedo: [0.55, 0.556, 0.554], roughness: 0.06, metallic: 1 },
  { name: 'Plastic', albedo: [0.05, 0.18, 0.55], roughness: 0.3, metallic: 0 },
  { name: 'Rubber', albedo: [0.02, 0.02, 0.02], roughness: 0.85, metallic: 0 },
  { name: 'Ceramic', albedo: [0.8, 0.78, 0.74], roughness: 0.12, metallic: 0 },
  { name: 'Car paint', albedo: [0.45, 0.01, 0.015], roughness: 0.15, metallic: 0.45 },
  { name: 'Clay', albedo: [0.42, 0.2, 0.12], roughness: 0.95, metallic: 0 },
];
