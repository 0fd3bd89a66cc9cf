/** Where deform edits move points: the twin of drgs/deform/maps.py, for the local picture and for sliders. */

import type { BendMap, Edit, LatticeMap, StretchMap, TwistMap } from './protocol.gen';

export type AnalyticMap = TwistMap | BendMap | StretchMap | LatticeMap;

/** Whether the browser can follow: simulations, clips and files of vertices are known to the server only. */
export function isAnalytic(edits: Edit[]): boolean {
  return edits.every((edit) => edit.op === 'material' || edit.op === 'environment' || (edit.op === 'deform' && edit.map != null));
}

/** Moved points, three numbers each; the same array where no edit moves anything. */
export function deformPoints(points: Float32Array, edits: Edit[]): Float32Array {
  const maps = edits.flatMap((edit) => (edit.op === 'deform' && edit.map ? [edit.map] : []));
  if (maps.length === 0) return points;
  const result = points.slice();
  for (const map of maps) {
    const move = mover(map);
    for (let i = 0; i < result.length; i += 3) [result[i], result[i + 1], result[i + 2]] = move(result[i]!, result[i + 1]!, result[i + 2]!);
  }
  return result;
}

type Mover = (x: number, y: number, z: number) => [number, number, number];

/** sin(t) / t. */
const sinc = (t: number) => (Math.abs(t) < 1e-6 ? 1 - (t * t) / 6 : Math.sin(t) / t);

function mover(map: AnalyticMap): Mover {
  switch (map.type) {
    case 'twist':
      return (x, y, z) => {
        const [cos, sin] = [Math.cos(map.rate * z), Math.sin(map.rate * z)];
        return [cos * x - sin * y, sin * x + cos * y, z];
      };
    case 'bend':
      return (x, y, z) => {
        const phi = map.curvature * z;
        const half = Math.sin(phi / 2) * sinc(phi / 2); // (1 - cos phi) / phi
        return [x * Math.cos(phi) + z * half, y, z * sinc(phi) - x * Math.sin(phi)];
      };
    case 'stretch': {
      const side = map.factor ** -0.5;
      return (x, y, z) => [x * side, y * side, z * map.factor];
    }
    case 'lattice':
      return latticeMover(map);
  }
}

function latticeMover({ minimum, maximum, control_points: grid }: LatticeMap): Mover {
  const sizes = [grid.length, grid[0]!.length, grid[0]![0]!.length];
  return (...point) => {
    const weights = sizes.map((size, axis) => bernstein((point[axis]! - minimum[axis]!) / (maximum[axis]! - minimum[axis]!), size - 1));
    const sum: [number, number, number] = [0, 0, 0];
    grid.forEach((plane, i) =>
      plane.forEach((line, j) =>
        line.forEach((control, k) => {
          const weight = weights[0]![i]! * weights[1]![j]! * weights[2]![k]!;
          for (let axis = 0; axis < 3; axis++) sum[axis]! += weight * control[axis]!;
        }),
      ),
    );
    return sum;
  };
}

/** Bernstein polynomials of a degree at t, by de Casteljau's recurrence. */
function bernstein(t: number, degree: number): number[] {
  let values = [1];
  for (let d = 1; d <= degree; d++) values = Array.from({ length: d + 1 }, (_, i) => (1 - t) * (values[i] ?? 0) + t * (values[i - 1] ?? 0));
  return values;
}

// ---- the lattice that the sliders show: eight corners, each level a scaled and shifted rectangle -------------------------

export interface Bounds {
  minimum: [number, number, number];
  maximum: [number, number, number];
}

export function boundsOf(points: Float32Array): Bounds {
  const result: Bounds = { minimum: [Infinity, Infinity, Infinity], maximum: [-Infinity, -Infinity, -Infinity] };
  points.forEach((value, i) => {
    if (value < result.minimum[i % 3]!) result.minimum[i % 3] = value;
    if (value > result.maximum[i % 3]!) result.maximum[i % 3] = value;
  });
  return result;
}

/** Widths of top and foot as factors; how far the top leans, in heights. */
export interface Lattice {
  top: number;
  foot: number;
  leanX: number;
  leanY: number;
}

export function latticeOf({ top, foot, leanX, leanY }: Lattice, { minimum, maximum }: Bounds): LatticeMap {
  const height = maximum[2] - minimum[2];
  const lean = [leanX * height, leanY * height];
  const corner = (i: number, j: number, k: number): [number, number, number] => {
    const at = [i, j].map((side, axis) => {
      const [low, high] = [minimum[axis]!, maximum[axis]!];
      return (low + high) / 2 + (side - 0.5) * (high - low) * (k ? top : foot) + (k ? lean[axis]! : 0);
    });
    return [at[0]!, at[1]!, k ? maximum[2] : minimum[2]];
  };
  return { type: 'lattice', minimum, maximum, control_points: [0, 1].map((i) => [0, 1].map((j) => [0, 1].map((k) => corner(i, j, k)))) };
}

export function readLattice({ minimum, maximum, control_points: grid }: LatticeMap): Lattice {
  const width = Math.max(1e-9, maximum[0] - minimum[0]);
  const height = Math.max(1e-9, maximum[2] - minimum[2]);
  const at = (i: number, j: number, k: number) => grid.at(-i)!.at(-j)!.at(-k)!; // 0: first, 1: last
  const span = (k: number) => (at(1, 0, k)[0] - at(0, 0, k)[0]) / width;
  const lean = (axis: 0 | 1) => ((at(0, 0, 1)[axis] + at(1, 1, 1)[axis]) / 2 - (minimum[axis] + maximum[axis]) / 2) / height;
  return { top: span(1), foot: span(0), leanX: lean(0), leanY: lean(1) };
}
