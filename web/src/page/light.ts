/** Lights of a page: lat-long tables unfolded to squares, which graphics cards look up quickly, and harmonics that turn. */

import type { Vec3 } from '../session/view';

/** Mean radiance arriving from each direction; the texel at (u, v) holds that of u = 0.5 - atan2(y, x) / 2π, v = acos(z) / π. */
export interface LatLong {
  /** Twice as many columns. */
  rows: number;
  /** Red, green, blue. */
  radiance: Float32Array;
}

/** The largest number of a half float. */
const BRIGHTEST = 65504;

/**
 * All levels of a light lie in one sheet, each as the unfolded octahedron of directions: two plain lookups are quicker than one in a cube with
 * levels, by far where no graphics card helps. The sharpest level fills a square of its own, the others a column beside it, from above. The rim of a
 * square, one texel wide, repeats what lies across its edge.
 */
export const SHARP_SIDE = 192;
export const SOFT_SIDE = 64;
export const SHEET_WIDTH = SHARP_SIDE + SOFT_SIDE;
export const sheetHeight = (levels: number) => Math.max(SHARP_SIDE, SOFT_SIDE * (levels - 1));

/** RGBA of the sheet, sharpest table first. */
export function lightSheet(tables: LatLong[]): Float32Array<ArrayBuffer> {
  const sheet = new Float32Array(4 * SHEET_WIDTH * sheetHeight(tables.length));
  tables.forEach((table, level) => {
    const side = level === 0 ? SHARP_SIDE : SOFT_SIDE;
    const [left, top] = level === 0 ? [0, 0] : [SHARP_SIDE, SOFT_SIDE * (level - 1)];
    for (let y = 0; y < side; y++)
      for (let x = 0, to = 4 * ((top + y) * SHEET_WIDTH + left); x < side; x++, to += 4) {
        lookUp(table, directionOnSheet((x - 0.5) / (side - 2), (y - 0.5) / (side - 2)), sheet, to);
        sheet[to + 3] = 1;
      }
  });
  return sheet;
}

/** Of a place of the unfolded octahedron, 0..1; a little beyond its edges it goes on where it is joined. */
export function directionOnSheet(u: number, v: number): Vec3 {
  if (u < 0 || u > 1) [u, v] = [u < 0 ? -u : 2 - u, 1 - v];
  if (v < 0 || v > 1) [u, v] = [1 - u, v < 0 ? -v : 2 - v];
  const [x, y] = [2 * u - 1, 2 * v - 1];
  const z = 1 - Math.abs(x) - Math.abs(y);
  return z >= 0 ? [x, y, z] : [x + (x >= 0 ? z : -z), y + (y >= 0 ? z : -z), z];
}

/** Bilinear, round the sky and up to the poles; writes three numbers. */
function lookUp({ rows, radiance }: LatLong, [x, y, z]: Vec3, out: Float32Array, to: number): void {
  const columns = 2 * rows;
  const across = (0.5 - Math.atan2(y, x) / (2 * Math.PI)) * columns - 0.5;
  const down = Math.min(rows - 1, Math.max(0, (Math.acos(z / Math.hypot(x, y, z)) / Math.PI) * rows - 0.5));
  const left = Math.floor(across);
  const top = Math.min(rows - 2, Math.floor(down));
  const [fx, fy] = [across - left, down - top];
  const column = [(left + columns) % columns, (left + 1 + columns) % columns] as const;
  for (let k = 0; k < 3; k++) {
    const texel = (row: number, side: 0 | 1) => radiance[3 * (row * columns + column[side]) + k]!;
    const upper = texel(top, 0) * (1 - fx) + texel(top, 1) * fx;
    const lower = texel(top + 1, 0) * (1 - fx) + texel(top + 1, 1) * fx;
    out[to + k] = Math.min(BRIGHTEST, upper * (1 - fy) + lower * fy);
  }
}

/** Pairs of coefficients that a turn about z mixes: which goes with the sine and which with the cosine of how many times the azimuth. */
const TURNING: [sine: number, cosine: number, times: number][] = [
  [1, 3, 1],
  [5, 7, 1],
  [4, 8, 2],
];

/** Harmonics of the same light turned counter-clockwise, seen from above. The order is that of drgs/maths/spherical_harmonics.py. */
export function turnHarmonics(harmonics: Vec3[], degrees: number): Vec3[] {
  const turned = harmonics.map((color) => [...color] as Vec3);
  for (const [sine, cosine, times] of TURNING) {
    const angle = (times * degrees * Math.PI) / 180;
    const [s, c] = [Math.sin(angle), Math.cos(angle)];
    for (let k = 0; k < 3; k++) {
      turned[sine]![k] = c * harmonics[sine]![k]! + s * harmonics[cosine]![k]!;
      turned[cosine]![k] = c * harmonics[cosine]![k]! - s * harmonics[sine]![k]!;
    }
  }
  return turned;
}
