import { expect, it } from 'vitest';
import { pyramidLines } from '../../src/capture/pyramid_lines';

it('draws a camera from its place to the corners of its picture, and round it', () => {
  const lines = pyramidLines(
    { name: 'a', width: 4, height: 2, left: -0.5, right: 0.5, bottom: -0.25, top: 0.25, world_from_camera: [[0, 0, 1, 5], [1, 0, 0, 6], [0, 1, 0, 7], [0, 0, 0, 1]] },
    2,
  );
  expect(lines.length).toBe(8 * 2 * 3);
  const ends = Array.from({ length: 16 }, (_, k) => lines.slice(3 * k, 3 * k + 3));
  // Backwards of this camera is x, its right is y and its up is z.
  expect(ends[0]).toEqual([5, 6, 7]);
  expect(ends[1]).toEqual([3, 5, 7.5]);
  expect(ends.filter(([x]) => x === 5).length).toBe(4);
  expect(new Set(ends.filter(([x]) => x === 3).map(String))).toEqual(new Set(['3,5,7.5', '3,7,7.5', '3,7,6.5', '3,5,6.5']));
});
