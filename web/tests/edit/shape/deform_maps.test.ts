import { expect, it } from 'vitest';
import { boundsOf } from '../../../src/edit/mesh';
import { deformPoint, deformPoints, undeformPoint, type AnalyticMap } from '../../../src/edit/shape/deform_maps';
import { adjusted, cornersOf, edgesOf, latticeOf, readLattice, restLattice, withCorner } from '../../../src/edit/shape/lattice';
import type { Edit } from '../../../src/session/protocol.gen';

const moved = (map: AnalyticMap, ...point: number[]) => [...deformPoints(Float32Array.from(point), [{ op: 'deform', map }])];
const close = (found: number[], wanted: number[]) => found.forEach((value, i) => expect(value).toBeCloseTo(wanted[i]!, 5));

it('a twist turns by rate times height', () => close(moved({ type: 'twist', rate: Math.PI }, 1, 0, 0.5), [0, 1, 0.5]));

it('a bend lays the axis on a circle towards +x', () => {
  const k = Math.PI / 2;
  close(moved({ type: 'bend', curvature: k }, 0, 0.3, 1), [1 / k, 0.3, 1 / k]);
  close(moved({ type: 'bend', curvature: 0 }, 0.2, 0.3, 1), [0.2, 0.3, 1]);
});

it('a stretch keeps the volume', () => close(moved({ type: 'stretch', factor: 4 }, 1, 1, 1), [0.5, 0.5, 4]));

it('a lattice at rest moves nothing, and its sliders can be read back', () => {
  const bounds = boundsOf(Float32Array.from([-1, -2, 0, 1, 2, 3]));
  close(moved(latticeOf({ top: 1, foot: 1, leanX: 0, leanY: 0 }, bounds), 0.3, -0.7, 1.1), [0.3, -0.7, 1.1]);
  const wanted = { top: 0.5, foot: 1.25, leanX: 0.25, leanY: -0.5 };
  const map = latticeOf(wanted, bounds);
  const read = readLattice(map);
  for (const key of ['top', 'foot', 'leanX', 'leanY'] as const) expect(read[key]).toBeCloseTo(wanted[key], 6);
  close(moved(map, 1, 0, 3), [0.5 + 0.25 * 3, -1.5, 3]);
});

it('without deformations the same array comes back', () => {
  const points = new Float32Array(3);
  expect(deformPoints(points, [{ op: 'environment' }])).toBe(points);
});

it('maps one behind the other can be taken back', () => {
  const bounds = boundsOf(Float32Array.from([-1, -2, 0, 1, 2, 3]));
  const lattice = withCorner(latticeOf({ top: 0.6, foot: 1.2, leanX: 0.3, leanY: 0 }, bounds), 7, [1.4, 1.1, 3.5]);
  const edits: Edit[] = ([{ type: 'twist', rate: 2 }, { type: 'bend', curvature: 0.4 }, { type: 'stretch', factor: 1.5 }, lattice] as AnalyticMap[]).map((map) => ({ op: 'deform', map }));
  for (const point of [[0.5, -1, 2.5], [-0.9, 0.2, 0.1]] as [number, number, number][]) close(undeformPoint(deformPoint(point, edits), edits), point);
});

it('a corner moves alone, and the sliders leave it its own way', () => {
  const map = restLattice(boundsOf(Float32Array.from([0, 0, 0, 1, 1, 1])));
  const moved = withCorner(map, 7, [1.5, 1, 1]);
  expect(cornersOf(moved).filter(({ place, rest }) => place.some((value, axis) => value !== rest[axis])).map(({ number }) => number)).toEqual([7]);
  const leaning = adjusted(moved, { leanX: readLattice(moved).leanX + 0.5 });
  close(cornersOf(leaning)[7]!.place, [2, 1, 1]);
  close(cornersOf(leaning)[1]!.place, [0.5, 0, 1]);
  expect(edgesOf(map)).toHaveLength(12);
});
