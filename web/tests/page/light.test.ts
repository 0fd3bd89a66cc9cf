import { expect, test } from 'vitest';
import { directionOnSheet, lightSheet, SHARP_SIDE, SHEET_WIDTH, sheetHeight, SOFT_SIDE, turnHarmonics } from '../../src/page/light';
import type { Vec3 } from '../../src/session/view';

/** Radiance that grows along each axis: red with x, green with y, blue with z. */
function gradient(rows: number) {
  const radiance = new Float32Array(6 * rows * rows);
  for (let row = 0; row < rows; row++)
    for (let column = 0; column < 2 * rows; column++) {
      const azimuth = (0.5 - (column + 0.5) / (2 * rows)) * 2 * Math.PI;
      const polar = ((row + 0.5) / rows) * Math.PI;
      const direction = [Math.cos(azimuth) * Math.sin(polar), Math.sin(azimuth) * Math.sin(polar), Math.cos(polar)];
      direction.forEach((value, k) => (radiance[3 * (row * 2 * rows + column) + k] = 2 + value));
    }
  return { rows, radiance };
}

const length = (direction: Vec3) => Math.hypot(...direction);

test('the sheet shows each direction where the shader looks for it, on every level', () => {
  const levels = 6;
  const sheet = lightSheet(Array.from({ length: levels }, () => gradient(64)));
  for (const [level, x, y] of [[0, 30, 100], [0, 96, 95], [1, 60, 5], [2, 31, 30], [5, 10, 40]] as const) {
    const side = level === 0 ? SHARP_SIDE : SOFT_SIDE;
    const direction = directionOnSheet((x - 0.5) / (side - 2), (y - 0.5) / (side - 2));
    const [left, top] = level === 0 ? [0, 0] : [SHARP_SIDE, SOFT_SIDE * (level - 1)];
    const at = 4 * ((top + y) * SHEET_WIDTH + left + x);
    direction.forEach((value, k) => expect(sheet[at + k]).toBeCloseTo(2 + value / length(direction), 1));
  }
  expect(sheet.length).toBe(4 * SHEET_WIDTH * sheetHeight(levels));
});

test('a square goes on beyond its edges where it is joined', () => {
  const step = 0.004;
  for (let place = 0.05; place < 1; place += 0.1)
    for (const [u, v] of [[0, place], [1, place], [place, 0], [place, 1]] as const) {
      const within = directionOnSheet(u === 0 ? step : u === 1 ? 1 - step : u, v === 0 ? step : v === 1 ? 1 - step : v);
      const beyond = directionOnSheet(u === 0 ? -step : u === 1 ? 1 + step : u, v === 0 ? -step : v === 1 ? 1 + step : v);
      const cosine = within.reduce((sum, value, k) => sum + value * beyond[k]!, 0) / length(within) / length(beyond);
      expect(cosine).toBeGreaterThan(Math.cos(0.06));
    }
});

/** As drgs/maths/spherical_harmonics.py, degree 2. */
function basis([x, y, z]: Vec3): number[] {
  const [k0, k1, k20, k21, k22] = [0.5 / Math.sqrt(Math.PI), Math.sqrt(3 / (4 * Math.PI)), Math.sqrt(5 / (16 * Math.PI)), Math.sqrt(15 / (4 * Math.PI)), Math.sqrt(15 / (16 * Math.PI))];
  return [k0, -k1 * y, k1 * z, -k1 * x, k21 * x * y, -k21 * y * z, k20 * (2 * z * z - x * x - y * y), -k21 * x * z, k22 * (x * x - y * y)];
}

test('turned harmonics have in a turned direction what they had in the direction itself', () => {
  const harmonics = Array.from({ length: 9 }, (_, i) => [Math.sin(i + 1), Math.cos(3 * i), i / 9] as Vec3);
  const at = (values: Vec3[], direction: Vec3) => [0, 1, 2].map((k) => basis(direction).reduce((sum, value, i) => sum + value * values[i]![k]!, 0));
  const direction: Vec3 = [0.48, -0.6, 0.64];
  for (const degrees of [0, 30, 90, -135]) {
    const [s, c] = [Math.sin((degrees * Math.PI) / 180), Math.cos((degrees * Math.PI) / 180)];
    const there: Vec3 = [c * direction[0] - s * direction[1], s * direction[0] + c * direction[1], direction[2]];
    const found = at(turnHarmonics(harmonics, degrees), there);
    at(harmonics, direction).forEach((value, k) => expect(found[k]).toBeCloseTo(value, 6));
  }
});
