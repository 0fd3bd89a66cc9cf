/** VertexMaterials of the mesh's vertices under edits: the twin of the material half of drgs/deform/pose_scene.py. */

import type { Edit, MaterialEdit } from '../../session/protocol.gen';
import type { Vec3 } from '../../session/view';
import type { RestMesh, VertexMaterials } from '../mesh';
import { selectVertices } from './select_vertices';

export interface MaterialMean {
  /** Linear. */
  albedo: Vec3;
  roughness: number;
  metallic: number;
}

/** VertexMaterials with the material edits applied in order; the captured ones, the same arrays, where there are none. */
export function applyMaterials(mesh: RestMesh, edits: Edit[]): VertexMaterials {
  const material = edits.filter((edit): edit is MaterialEdit => edit.op === 'material');
  if (material.length === 0) return mesh.materials;
  const result: VertexMaterials = { albedo: mesh.materials.albedo.slice(), roughness: mesh.materials.roughness.slice(), metallic: mesh.materials.metallic.slice() };
  for (const { select, set, mode } of material) {
    const weights = selectVertices(mesh, select);
    const move = (values: Float32Array, wanted: readonly number[]) => {
      const width = wanted.length;
      for (let i = 0; i < weights.length; i++) {
        const weight = weights[i]!;
        if (weight === 0) continue;
        for (let k = 0; k < width; k++) {
          const old = values[width * i + k]!;
          const goal = mode === 'multiply' ? Math.min(1, Math.max(0, old * wanted[k]!)) : wanted[k]!;
          values[width * i + k] = old * (1 - weight) + goal * weight;
        }
      }
    };
    if (set.albedo) move(result.albedo, set.albedo);
    if (set.roughness != null) move(result.roughness, [set.roughness]);
    if (set.metallic != null) move(result.metallic, [set.metallic]);
  }
  return result;
}

/** Mean over the vertices, by weight; null where nothing is selected. */
export function meanMaterial({ albedo, roughness, metallic }: VertexMaterials, weights: Float32Array): MaterialMean | null {
  let total = 0;
  const sum = [0, 0, 0, 0, 0];
  for (let i = 0; i < weights.length; i++) {
    const weight = weights[i]!;
    if (weight === 0) continue;
    total += weight;
    for (let k = 0; k < 3; k++) sum[k]! += weight * albedo[3 * i + k]!;
    sum[3]! += weight * roughness[i]!;
    sum[4]! += weight * metallic[i]!;
  }
  if (total === 0) return null;
  const [red, green, blue, rough, metal] = sum.map((value) => value / total) as [number, number, number, number, number];
  return { albedo: [red, green, blue], roughness: rough, metallic: metal };
}
