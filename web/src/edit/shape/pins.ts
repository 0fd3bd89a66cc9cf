/** What a simulation holds in place: vertices of the mesh, painted on the object. */

import { computed, effect, signal } from '@preact/signals';
import { openedAsset } from '../../session/session';
import type { Vec3 } from '../../session/view';
import { withDab } from '../material/selection';
import { bounds, mesh } from '../mesh';
import { pins, setPins } from './matter';

/** Share of the object's height that `Top` and `Foot` hold. */
const SLICE = 0.12;

/** 0 or 1 for each vertex, while a stroke is being painted; it is one change of the session. */
const stroke = signal<number[] | null>(null);
const vertexCount = () => (mesh.value?.positions.length ?? 0) / 3;
/** 0 or 1 for each vertex. */
const held = computed(() => {
  if (stroke.value) return stroke.value;
  const weights = new Array<number>(vertexCount()).fill(0);
  for (const vertex of pins.value) if (vertex < weights.length) weights[vertex] = 1;
  return weights;
});
/** For the highlight on the object. */
export const pinWeights = computed(() => (mesh.value ? Float32Array.from(held.value) : null));
export const pinnedShare = computed(() => held.value.reduce((sum, weight) => sum + weight, 0) / Math.max(1, held.value.length));

const hold = (weights: number[]) => setPins(weights.flatMap((weight, vertex) => (weight > 0 ? [vertex] : [])));
export const holdNothing = () => setPins([]);

effect(() => {
  openedAsset.value;
  stroke.value = null;
});

export function paintPins(point: Vec3, erase: boolean): void {
  const positions = mesh.value?.positions;
  if (positions) stroke.value = withDab(held.value, positions, point, erase, 0);
}

/** The brush is lifted. */
export function endStroke(): void {
  const painted = stroke.value;
  if (!painted) return;
  hold(painted);
  stroke.value = null;
}

export function holdEnd(end: 'top' | 'foot'): void {
  const positions = mesh.value?.positions;
  if (!positions) return;
  const { minimum, maximum } = bounds.value;
  const limit = SLICE * (maximum[2] - minimum[2]);
  const within = (z: number) => (end === 'top' ? z >= maximum[2] - limit : z <= minimum[2] + limit);
  hold(held.value.map((weight, vertex) => (within(positions[3 * vertex + 2]!) ? 1 : weight)));
}
