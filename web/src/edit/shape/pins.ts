/** What a simulation holds in place: vertices of the mesh, painted on the object. */

import { computed, effect, signal } from '@preact/signals';
import { openedAsset } from '../../session/session';
import type { Vec3 } from '../../session/view';
import { withDab } from '../material/selection';
import { bounds, mesh } from '../mesh';

/** Share of the object's height that `Top` and `Foot` hold. */
const SLICE = 0.12;

/** 0 or 1 for each vertex; null: nothing is held. */
const painted = signal<number[] | null>(null);
/** For the highlight on the object. */
export const pinWeights = computed(() => (mesh.value ? Float32Array.from(painted.value ?? new Array<number>(mesh.value.positions.length / 3).fill(0)) : null));
/** Numbers of the vertices that are held. */
export const pins = computed(() => (painted.value ?? []).flatMap((weight, vertex) => (weight > 0 ? [vertex] : [])));
export const pinnedShare = computed(() => (painted.value ? pins.value.length / Math.max(1, painted.value.length) : 0));

export const forgetPins = () => void (painted.value = null);

effect(() => {
  openedAsset.value;
  forgetPins();
});

export function paintPins(point: Vec3, erase: boolean): void {
  const positions = mesh.value?.positions;
  if (positions) painted.value = withDab(painted.value ?? new Array<number>(positions.length / 3).fill(0), positions, point, erase, 0);
}

export function holdEnd(end: 'top' | 'foot'): void {
  const positions = mesh.value?.positions;
  if (!positions) return;
  const { minimum, maximum } = bounds.value;
  const limit = SLICE * (maximum[2] - minimum[2]);
  const held = (z: number) => (end === 'top' ? z >= maximum[2] - limit : z <= minimum[2] + limit);
  painted.value = Array.from({ length: positions.length / 3 }, (_, i) => (held(positions[3 * i + 2]!) ? 1 : (painted.value?.[i] ?? 0)));
}
