import { expect, it } from 'vitest';
import type { AnalyticMap } from '../src/shape';
import { boundsOf, deformPoints, latticeOf, readLattice } from '../src/shape';

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
