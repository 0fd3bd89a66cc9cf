/** Tools that choose the part of the object which material edits go to. Points are of the object at rest, as selections are. */

import { computed, signal } from '@preact/signals';
import type { Triple } from './color';
import { meshRegions } from './materials';
import type { Selection } from './protocol.gen';
import { boundsOf } from './shape';
import { EVERYTHING, flash, mesh, selection, tool, type Tool } from './state';

/** Largest material difference that `similar` crosses. */
export const tolerance = signal(0.1);
/** Radius of sphere and brush, half the side of the box, as a share of the object's own radius. */
export const size = signal(0.3);
/** Width of the soft rim, as a share of the size. */
export const softness = signal(0.3);

/** Half the diagonal of the mesh's bounding box [world units]. */
export const objectRadius = computed(() => {
  const { minimum, maximum } = boundsOf(mesh.value?.positions ?? new Float32Array(3));
  return Math.hypot(...maximum.map((value, k) => value - minimum[k]!)) / 2;
});

interface Picked {
  point: Triple;
  vertex: number;
}
let picked: Picked | null = null;

export function chooseTool(next: Tool): void {
  tool.value = next;
  if (next === 'all') select(EVERYTHING);
  else if (next !== 'brush' && picked) selectAt(picked);
}

export function selectAll(): void {
  picked = null;
  chooseTool('all');
}

export function selectAt(at: Picked): void {
  picked = at;
  const radius = Math.max(1e-6, size.value * objectRadius.value);
  const falloff = softness.value * radius;
  switch (tool.value) {
    case 'region':
      return select({ region: meshRegions(mesh.value!)[at.vertex]! });
    case 'similar':
      return select({ similar: { point: at.point, tolerance: tolerance.value } });
    case 'sphere':
      return select({ sphere: { center: at.point, radius, falloff } });
    case 'box':
      return select({ box: { minimum: at.point.map((value) => value - radius) as Triple, maximum: at.point.map((value) => value + radius) as Triple, falloff } });
  }
}

/** After a change of tolerance, size or softness. */
export function selectAgain(): void {
  if (picked && tool.value !== 'all' && tool.value !== 'brush') selectAt(picked);
}

function select(next: Selection): void {
  selection.value = next;
  flash.value++;
}

/** Add the brush's dab to the painted weights, or take it away. */
export function paint(point: Triple, erase: boolean): void {
  const positions = mesh.value?.positions;
  if (!positions) return;
  select({ vertex_weights: dabbed(selection.value.vertex_weights ?? new Array<number>(positions.length / 3).fill(0), positions, point, erase, softness.value) });
}

/** Weights of vertices with one dab more, or taken away. */
export function dabbed(painted: number[], positions: Float32Array, point: Triple, erase: boolean, soft: number): number[] {
  const weights = painted.slice();
  const radius = 0.5 * size.value * objectRadius.value;
  const core = radius * (1 - soft);
  for (let i = 0; i < weights.length; i++) {
    const distance = Math.hypot(positions[3 * i]! - point[0], positions[3 * i + 1]! - point[1], positions[3 * i + 2]! - point[2]);
    if (distance >= radius) continue;
    const t = Math.min(1, (radius - distance) / Math.max(1e-9, radius - core));
    const dab = Math.round(100 * t * t * (3 - 2 * t)) / 100; // two digits keep the edit short
    weights[i] = erase ? Math.min(weights[i]!, 1 - dab) : Math.max(weights[i]!, dab);
  }
  return weights;
}
