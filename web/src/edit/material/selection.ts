/** The part of the object that material edits go to, and the tools that choose it. Points are of the object at rest, as selections are. */

import { computed, effect, signal } from '@preact/signals';
import type { Selection } from '../../session/protocol.gen';
import { openedAsset } from '../../session/session';
import type { Vec3 } from '../../session/view';
import { weightsOf } from '../../session/weights';
import { mesh, objectRadius } from '../mesh';
import { meshRegions, selectVertices } from './select_vertices';

export type Tool = 'all' | 'region' | 'similar' | 'sphere' | 'box' | 'brush';
const EVERYTHING: Selection = { all: true };

export const tool = signal<Tool>('all');
export const selection = signal<Selection>(EVERYTHING);
/** Largest material difference that `similar` crosses. */
export const tolerance = signal(0.1);
/** Radius of sphere and brush, half the side of the box, as a share of the object's own radius. */
export const size = signal(0.3);
/** Width of the soft rim, as a share of the size. */
export const softness = signal(0.3);
/** Raised to let the selection flash. */
export const flash = signal(0);

/** Weight 0..1 of each vertex; null while there is no mesh. */
export const selectionWeights = computed(() => mesh.value && selectVertices(mesh.value, selection.value));
/** Share of the vertices that is selected. */
export const selectedShare = computed(() => (selectionWeights.value ? selectionWeights.value.reduce((sum, weight) => sum + weight, 0) / selectionWeights.value.length : 0));

interface SurfacePoint {
  point: Vec3;
  /** The nearest one. */
  vertex: number;
}
/** Where the selection was made, so that other tools and sizes can begin there. */
let picked: SurfacePoint | null = null;

effect(() => {
  openedAsset.value;
  picked = null;
  selection.value = EVERYTHING;
  tool.value = 'all';
});

export function chooseTool(next: Tool): void {
  tool.value = next;
  if (next === 'all') select(EVERYTHING);
  else if (next !== 'brush' && picked) selectAt(picked);
}

export function selectAll(): void {
  picked = null;
  chooseTool('all');
}

export function selectAt(at: SurfacePoint): void {
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
      return select({ box: { minimum: at.point.map((value) => value - radius) as Vec3, maximum: at.point.map((value) => value + radius) as Vec3, falloff } });
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

/** Brush over the selection's painted weights. */
export function paint(point: Vec3, erase: boolean): void {
  const positions = mesh.value?.positions;
  if (!positions) return;
  select({ vertex_weights: withDab(painted(positions.length / 3), positions, point, erase, softness.value) });
}

/** What is painted so far. */
function painted(count: number): number[] {
  const { vertex_weights, weights_file } = selection.value;
  return vertex_weights ?? Array.from((weights_file && weightsOf(weights_file)) || new Float32Array(count));
}

/** Vertex weights with one dab of the brush added, or taken away; `soft`: share of the dab's radius that is rim. */
export function withDab(weights: number[], positions: Float32Array, point: Vec3, erase: boolean, soft: number): number[] {
  const painted = weights.slice();
  const radius = 0.5 * size.value * objectRadius.value;
  const core = radius * (1 - soft);
  for (let i = 0; i < painted.length; i++) {
    const distance = Math.hypot(positions[3 * i]! - point[0], positions[3 * i + 1]! - point[1], positions[3 * i + 2]! - point[2]);
    if (distance >= radius) continue;
    const t = Math.min(1, (radius - distance) / Math.max(1e-9, radius - core));
    const dab = Math.round(100 * t * t * (3 - 2 * t)) / 100; // two digits keep the edit short
    painted[i] = erase ? Math.min(painted[i]!, 1 - dab) : Math.max(painted[i]!, dab);
  }
  return painted;
}
