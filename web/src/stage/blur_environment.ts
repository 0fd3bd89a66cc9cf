/**
 * The environment out of focus, as a background: the twin of drgs/render/film/blur_environment.py, with its formula and constants.
 * Rows may run from above or from below.
 */

export const BLURRED_HEIGHT = 64;
const BLUR_DEGREES = 7;
/** Weights of the lobe below e to the minus this are left out. */
const NEGLIGIBLE = 9;

/** RGBA of BLURRED_HEIGHT rows, twice as many columns; from a lat-long table of `height` rows, three or four numbers a texel. */
export function blurEnvironment(data: Float32Array, width: number, height: number): Float32Array<ArrayBuffer> {
  const rows = BLURRED_HEIGHT;
  const columns = 2 * rows;
  const small = shrink(data, width, height);
  const sharpness = 1 / ((BLUR_DEGREES * Math.PI) / 180) ** 2;
  const polar = Array.from({ length: rows }, (_, row) => ((row + 0.5) * Math.PI) / rows);
  const cosines = Array.from({ length: columns }, (_, shift) => Math.cos((shift * Math.PI) / rows));
  const blurred = new Float32Array(4 * rows * columns);
  const sum = new Float64Array(3 * columns);
  // Each row twice, one behind the other: the row turned by a shift is then a contiguous stretch.
  const twice = Array.from({ length: rows }, (_, row) => {
    const once = small.subarray(3 * columns * row, 3 * columns * (row + 1));
    return Float64Array.from({ length: 6 * columns }, (_, i) => once[i % (3 * columns)]!);
  });
  for (let row = 0; row < rows; row++) {
    let total = 0;
    sum.fill(0);
    for (let from = 0; from < rows; from++) {
      const across = Math.sin(polar[row]!) * Math.sin(polar[from]!);
      const along = Math.cos(polar[row]!) * Math.cos(polar[from]!);
      if (sharpness * (across + along - 1) < -NEGLIGIBLE) continue;
      const source = twice[from]!;
      for (let shift = 0; shift < columns; shift++) {
        const exponent = sharpness * (across * cosines[shift]! + along - 1);
        if (exponent < -NEGLIGIBLE) continue;
        const weight = Math.exp(exponent) * Math.sin(polar[from]!);
        total += weight;
        for (let i = 0, at = 3 * shift; i < sum.length; i++, at++) sum[i]! += weight * source[at]!;
      }
    }
    for (let column = 0; column < columns; column++) {
      for (let k = 0; k < 3; k++) blurred[4 * (row * columns + column) + k] = sum[3 * column + k]! / total;
      blurred[4 * (row * columns + column) + 3] = 1;
    }
  }
  return blurred;
}

/** RGB means over the texels that each small texel touches, rows weighed by the sine of their polar angle. */
function shrink(data: Float32Array, width: number, height: number): Float64Array {
  const rows = BLURRED_HEIGHT;
  const columns = 2 * rows;
  const channels = data.length / (width * height);
  const small = new Float64Array(3 * rows * columns);
  for (let row = 0; row < rows; row++) {
    const [top, bottom] = [Math.floor((row * height) / rows), Math.ceil(((row + 1) * height) / rows)];
    for (let column = 0; column < columns; column++) {
      const [left, right] = [Math.floor((column * width) / columns), Math.ceil(((column + 1) * width) / columns)];
      const to = 3 * (row * columns + column);
      let total = 0;
      for (let y = top; y < bottom; y++) {
        const weight = Math.sin(((y + 0.5) * Math.PI) / height);
        total += weight * (right - left);
        for (let x = left; x < right; x++) for (let k = 0; k < 3; k++) small[to + k]! += weight * data[channels * (y * width + x) + k]!;
      }
      for (let k = 0; k < 3; k++) small[to + k]! /= total;
    }
  }
  return small;
}
