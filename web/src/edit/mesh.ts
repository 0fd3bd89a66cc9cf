/** The open asset's mesh as captured: what selections, deformations and the local picture begin with. */

import { computed, effect, signal } from '@preact/signals';
import { openedAsset } from '../session/session';
import type { Vec3 } from '../session/view';

/** World units, z up. Three numbers a vertex or face, or one. */
export interface RestMesh {
  positions: Float32Array;
  normals: Float32Array;
  faces: Uint32Array;
  materials: VertexMaterials;
}

/** One entry a vertex; albedo is linear. */
export interface VertexMaterials {
  albedo: Float32Array;
  roughness: Float32Array;
  metallic: Float32Array;
}

export interface Bounds {
  minimum: Vec3;
  maximum: Vec3;
}

/** Null until the viewport has loaded it. */
export const mesh = signal<RestMesh | null>(null);

effect(() => {
  openedAsset.value;
  mesh.value = null;
});

/** Of the mesh at rest. */
export const bounds = computed(() => boundsOf(mesh.value?.positions ?? new Float32Array(3)));

/** Half the diagonal of the mesh's bounding box [world units]. */
export const objectRadius = computed(() => {
  const { minimum, maximum } = bounds.value;
  return Math.hypot(...maximum.map((value, axis) => value - minimum[axis]!)) / 2;
});

export function boundsOf(points: Float32Array): Bounds {
  const result: Bounds = { minimum: [Infinity, Infinity, Infinity], maximum: [-Infinity, -Infinity, -Infinity] };
  points.forEach((value, i) => {
    if (value < result.minimum[i % 3]!) result.minimum[i % 3] = value;
    if (value > result.maximum[i % 3]!) result.maximum[i % 3] = value;
  });
  return result;
}
