import { expect, test } from 'vitest';
import { between, moved, same, START, turned, viewOf, zoomed } from '../../src/page/orbit';
import type { Vec3 } from '../../src/session/view';

const LOW: Vec3 = [-1, -2, 3];
const HIGH: Vec3 = [3, 1, 5];
const CENTER: Vec3 = [1, -0.5, 4];
const PICTURE = { width: 800, height: 600 };
const FREE = { x: 300, y: 340, width: 500, height: 480 };

/** Place in the picture [pixels, y down] and depth -1..1. */
function project(clipFromWorld: Float32Array, point: Vec3): [number, number, number] {
  const [x, y, z, w] = [0, 1, 2, 3].map((row) => [...point, 1].reduce((sum, value, k) => sum + value * clipFromWorld[4 * k + row]!, 0)) as [number, number, number, number];
  return [((x / w + 1) / 2) * PICTURE.width, ((1 - y / w) / 2) * PICTURE.height, z / w];
}

test('the object stands in the middle of what nothing covers, and fits', () => {
  const { clipFromWorld, axes } = viewOf(START, LOW, HIGH, PICTURE, FREE);
  const [x, y, depth] = project(clipFromWorld, CENTER);
  expect(x).toBeCloseTo(FREE.x, 2);
  expect(y).toBeCloseTo(FREE.y, 2);
  expect(Math.abs(depth)).toBeLessThan(1);
  for (let corner = 0; corner < 8; corner++) {
    const place = project(clipFromWorld, [0, 1, 2].map((k) => ((corner >> k) & 1 ? HIGH : LOW)[k]!) as Vec3);
    expect(Math.abs(place[0] - FREE.x)).toBeLessThan(0.55 * FREE.width);
    expect(Math.abs(place[1] - FREE.y)).toBeLessThan(0.55 * FREE.height);
    expect(Math.abs(place[2])).toBeLessThan(1);
  }
  expect(axes.up[2]).toBeGreaterThan(0.5);
});

test('a place of the sky goes back to the direction that it shows', () => {
  const { eye, clipFromWorld, worldFromClip } = viewOf(turned(START, 40, -70), LOW, HIGH, PICTURE, FREE);
  for (const point of [CENTER, LOW, [2, 0.5, 3.2] as Vec3]) {
    const [x, y] = project(clipFromWorld, point);
    const clip = [(2 * x) / PICTURE.width - 1, 1 - (2 * y) / PICTURE.height, 1, 1];
    const far = [0, 1, 2, 3].map((row) => clip.reduce((sum, value, k) => sum + value * worldFromClip[4 * k + row]!, 0));
    const direction = [0, 1, 2].map((k) => far[k]! / far[3]! - eye[k]!);
    const wanted = point.map((value, k) => value - eye[k]!);
    const scale = Math.hypot(...wanted) / Math.hypot(...direction);
    direction.forEach((value, k) => expect(value * scale).toBeCloseTo(wanted[k]!, 3));
  }
});

test('the object follows the hand', () => {
  const place = (orbit: typeof START) => project(viewOf(orbit, LOW, HIGH, PICTURE, { x: 400, y: 300, width: 800, height: 600 }).clipFromWorld, CENTER);
  const [x, y] = place(moved(START, 0.1, 0.2));
  expect(x).toBeCloseTo(400 + 0.1 * 600, 0);
  expect(y).toBeCloseTo(300 - 0.2 * 600, 0);
});

test('nobody gets over the pole, too near or too far, and what is wanted is reached', () => {
  expect(turned(START, 0, 500).elevation).toBeLessThan(90);
  expect(zoomed(START, 1e-9).zoom).toBeGreaterThan(0);
  expect(zoomed(START, 1e9).zoom).toBeLessThan(100);
  const wanted = zoomed(turned(START, 100, 10), 0.5);
  expect(same(START, wanted)).toBe(false);
  expect(same(between(START, wanted, 1), wanted)).toBe(true);
});
