import { describe, expect, it } from 'vitest';
import { foundBox, rotationToUp, SIDES, sideCenter, sideName, turned, turnedBack, withSide } from '../../src/capture/build_box';
import type { CaptureLook } from '../../src/session/protocol.gen';
import type { Vec3 } from '../../src/session/view';

const look = (more: Partial<CaptureLook>) => ({ box_low: [-1, -2, -3], box_high: [1, 2, 3], box_origin: 'cameras', ...more }) as CaptureLook;
const near = (found: number[], expected: number[]) => found.forEach((value, k) => expect(value).toBeCloseTo(expected[k]!, 9));

describe('the turn that makes a direction up', () => {
  // Values of rotation_to_up (drgs/reconstruct/capture/turn_up.py), which cuts by boxes of the same world.
  const KNOWN: [Vec3, number[][]][] = [
    [[0, 0, 1], [[1, 0, 0], [0, 1, 0], [0, 0, 1]]],
    [[0, 0, -2], [[1, 0, 0], [0, -1, 0], [0, 0, -1]]],
    [[0, 1, 0], [[1, 0, 0], [0, 0, -1], [0, 1, 0]]],
    [[-3, 0, 0], [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]],
  ];
  it.each(KNOWN)('of %j', (up, rows) => rotationToUp(up).forEach((row, k) => near(row, rows[k]!)));

  it.each([[[0.3, -0.5, 0.2]], [[1e-7, 0, -1]], [[1e-4, 1e-4, -1]]] as [Vec3][])('of %j is a rotation, and goes back', (up) => {
    const rows = rotationToUp(up);
    near(turned(rows, up), [0, 0, Math.hypot(...up)]);
    near(turnedBack(rows, turned(rows, [0.2, -0.7, 1.3])), [0.2, -0.7, 1.3]);
    const [a, b, c] = rows;
    near([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]], c); // right-handed
  });
});

it('the box of a turned world holds the outermost places, and no more', () => {
  const found = foundBox(look({ outermost: [0, 0, 5, 0, 2, 0, 1, -1, -1] }), [0, 1, 0])!;
  near(found.low, [0, -5, -1]);
  near(found.high, [1, 1, 2]);
});

it('a guess stays as wide in a turned world, about the turned middle', () => {
  const found = foundBox(look({ box_low: [0, 2, 0], box_high: [2, 4, 2] }), [0, 1, 0])!;
  near(found.low, [0, -2, 2]);
  near(found.high, [2, 0, 4]);
  expect(foundBox(look({ box_low: null, box_high: null }), [0, 0, 1])).toBeNull();
});

it('sides are moved one at a time, and stay before the one across', () => {
  const box = { low: [-1, -1, -1] as Vec3, high: [1, 1, 1] as Vec3 };
  const right = SIDES[1]!;
  const bottom = SIDES[4]!;
  expect([sideName(right), sideName(bottom)]).toEqual(['+x', '−z']);
  expect(withSide(box, right, 2, box)).toEqual({ low: [-1, -1, -1], high: [2, 1, 1] });
  expect(sideCenter(withSide(box, bottom, 0.5, box), bottom)).toEqual([0, 0, 0.5]);
  near(withSide(box, bottom, 7, box).low, [-1, -1, 1 - 0.01 * Math.sqrt(12)]);
});
