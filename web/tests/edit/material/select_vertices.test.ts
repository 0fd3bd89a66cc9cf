import { expect, it } from 'vitest';
import { meshRegions, selectVertices } from '../../../src/edit/material/select_vertices';
import type { Selection } from '../../../src/session/protocol.gen';
import { strip } from './strip';

const weights = (select: Selection) => [...selectVertices(strip(), select)];

it('regions are patches without a jump in material, the largest first', () => {
  expect([...meshRegions(strip())]).toEqual([0, 0, 0, 0, 1, 1]);
  expect(weights({ region: 1 })).toEqual([0, 0, 0, 0, 1, 1]);
});

it('similar floods over what is within the tolerance of the picked vertex', () => {
  expect(weights({ similar: { point: [4.9, 1, 0] } })).toEqual([0, 0, 0, 0, 1, 1]);
  expect(weights({ similar: { point: [0, 0, 0], tolerance: 1 } })).toEqual([1, 1, 1, 1, 0, 0]);
});

it('spheres and boxes fall off smoothly outside', () => {
  const [first, second, third] = weights({ sphere: { center: [0, 0, 0], radius: 1, falloff: 2 } });
  expect(first).toBe(1);
  expect(second).toBeCloseTo((() => { const t = 1 - (Math.SQRT2 - 1) / 2; return t * t * (3 - 2 * t); })(), 6);
  expect(third).toBeCloseTo(0.5, 6); // half way through the rim
  expect(weights({ box: { minimum: [0, 0, 0], maximum: [2, 1, 0] } })).toEqual([1, 1, 1, 0, 0, 0]);
});
