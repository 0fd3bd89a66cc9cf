/** The lattice of eight corners: corner by corner, and as the sliders show it, where top and foot are scaled and shifted rectangles. */

import type { LatticeMap } from '../../session/protocol.gen';
import type { Vec3 } from '../../session/view';
import type { Bounds } from '../mesh';

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
  const corner = (i: number, j: number, k: number): Vec3 => {
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

const STRAIGHT: Lattice = { top: 1, foot: 1, leanX: 0, leanY: 0 };

/** The lattice that moves nothing. */
export const restLattice = (bounds: Bounds) => latticeOf(STRAIGHT, bounds);

/** The lattice after a slider was moved; corners that were moved one by one stay as far beside the sliders' lattice. */
export function adjusted(map: LatticeMap, change: Partial<Lattice>): LatticeMap {
  const now = readLattice(map);
  const [before, after] = [latticeOf(now, map), latticeOf({ ...now, ...change }, map)];
  return mapCorners(map, (corner, i, j, k) => {
    const [from, to] = [before, after].map(({ control_points: grid }) => grid[i]?.[j]?.[k]);
    return from && to ? (corner.map((value, axis) => value + to[axis]! - from[axis]!) as Vec3) : corner;
  });
}

const mapCorners = (map: LatticeMap, change: (corner: Vec3, i: number, j: number, k: number) => Vec3): LatticeMap => ({
  ...map,
  control_points: map.control_points.map((plane, i) => plane.map((line, j) => line.map((corner, k) => change(corner, i, j, k)))),
});

export interface Corner {
  /** Among all corners, x slowest. */
  number: number;
  place: Vec3;
  /** Where it is in a lattice that moves nothing. */
  rest: Vec3;
}

const numberOf = ({ control_points: grid }: LatticeMap, i: number, j: number, k: number) => (i * grid[0]!.length + j) * grid[0]![0]!.length + k;

export function cornersOf(map: LatticeMap): Corner[] {
  const { minimum, maximum, control_points: grid } = map;
  const sizes = [grid.length, grid[0]!.length, grid[0]![0]!.length];
  return grid.flatMap((plane, i) =>
    plane.flatMap((line, j) =>
      line.map((place, k) => ({
        number: numberOf(map, i, j, k),
        place,
        rest: [i, j, k].map((at, axis) => minimum[axis]! + ((maximum[axis]! - minimum[axis]!) * at) / (sizes[axis]! - 1)) as Vec3,
      })),
    ),
  );
}

export const withCorner = (map: LatticeMap, number: number, place: Vec3) => mapCorners(map, (corner, i, j, k) => (numberOf(map, i, j, k) === number ? place : corner));

/** Pairs of neighbouring corners, by number. */
export function edgesOf(map: LatticeMap): [number, number][] {
  const edges: [number, number][] = [];
  map.control_points.forEach((plane, i) =>
    plane.forEach((line, j) =>
      line.forEach((_, k) => {
        const here = numberOf(map, i, j, k);
        if (map.control_points[i + 1]) edges.push([here, numberOf(map, i + 1, j, k)]);
        if (plane[j + 1]) edges.push([here, numberOf(map, i, j + 1, k)]);
        if (k + 1 < line.length) edges.push([here, numberOf(map, i, j, k + 1)]);
      }),
    ),
  );
  return edges;
}
