import { expect, it } from 'vitest';
import { blurEnvironment, BLURRED_HEIGHT } from '../../src/stage/blur_environment';

const rows = BLURRED_HEIGHT;
const columns = 2 * rows;

it('a constant environment of any size stays constant', () => {
  for (const height of [2, 17, 128]) {
    const blurred = blurEnvironment(new Float32Array(3 * 2 * height * height).fill(0.7), 2 * height, height);
    expect(blurred.length).toBe(4 * rows * columns);
    expect(Math.max(...blurred.map((value, i) => Math.abs(value - (i % 4 === 3 ? 1 : 0.7))))).toBeLessThan(1e-5);
  }
});

it('a point of light becomes the same lobe as on the server', () => {
  const point = new Float32Array(4 * rows * columns);
  point[4 * (12 * columns + 30)] = 1;
  const blurred = blurEnvironment(point, columns, rows);
  const direction = (row: number, column: number) => {
    const [polar, azimuth] = [((row + 0.5) * Math.PI) / rows, (column * Math.PI) / rows];
    return [Math.sin(polar) * Math.cos(azimuth), Math.sin(polar) * Math.sin(azimuth), Math.cos(polar)];
  };
  const middle = direction(12, 30);
  const peak = Math.max(...blurred.filter((_, i) => i % 4 === 0));
  for (const [row, column] of [[12, 30], [12, 34], [16, 30], [6, 40], [18, 25], [40, 90]] as const) {
    const cosine = direction(row, column).reduce((sum, value, axis) => sum + value * middle[axis]!, 0);
    const lobe = Math.exp((cosine - 1) / ((7 * Math.PI) / 180) ** 2);
    expect(Math.abs(blurred[4 * (row * columns + column)]! / peak - lobe)).toBeLessThan(3e-3);
  }
});
