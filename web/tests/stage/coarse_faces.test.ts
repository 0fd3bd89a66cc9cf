import { SphereGeometry } from 'three';
import { expect, test } from 'vitest';
import { coarseFaces } from '../../src/stage/coarse_faces';

function ball(side: number): { positions: Float32Array; faces: Uint32Array } {
  const geometry = new SphereGeometry(1, 2 * side, side);
  return { positions: geometry.getAttribute('position').array as Float32Array, faces: new Uint32Array(geometry.index!.array) };
}

test('a mesh of few faces keeps them', () => {
  const { positions, faces } = ball(20);
  expect(coarseFaces(positions, faces)).toBe(faces);
});

test('fewer faces stay near the surface and cover it', () => {
  const { positions, faces } = ball(200);
  const coarse = coarseFaces(positions, faces, 10_000);
  expect(coarse.length / 3).toBeLessThanOrEqual(10_000);
  expect(coarse.length / 3).toBeGreaterThan(3000);
  let area = 0;
  for (let i = 0; i < coarse.length; i += 3) {
    const corner = (k: number) => [0, 1, 2].map((axis) => positions[3 * coarse[i + k]! + axis]!) as [number, number, number];
    const [a, b, c] = [corner(0), corner(1), corner(2)];
    const u = b.map((x, axis) => x - a[axis]!) as typeof a;
    const v = c.map((x, axis) => x - a[axis]!) as typeof a;
    area += 0.5 * Math.hypot(u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]);
  }
  expect(area / (4 * Math.PI)).toBeGreaterThan(0.9);
  expect(area / (4 * Math.PI)).toBeLessThan(1.25);
});
