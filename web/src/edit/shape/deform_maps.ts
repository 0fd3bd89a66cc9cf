/** Where deform edits move points: the twin of drgs/deform/displace/maps.py, for the local picture and for sliders. */

import type { BendMap, Edit, LatticeMap, StretchMap, TwistMap } from '../../session/protocol.gen';
import type { Vec3 } from '../../session/view';

export type AnalyticMap = TwistMap | BendMap | StretchMap | LatticeMap;

/** Whether the browser can compute the shape: what simulations, clips, files of vertices and dragged handles do is asked of the server. */
export function isAnalytic(edits: Edit[]): boolean {
  return edits.every((edit) => edit.op === 'material' || edit.op === 'environment' || edit.op === 'matter' || edit.op === 'variant' || (edit.op === 'deform' && (edit.map != null || (edit.handles != null && !edit.handles.drag?.length))));
}

const mapsOf = (edits: Edit[]) => edits.flatMap((edit) => (edit.op === 'deform' && edit.map ? [edit.map] : []));

/** Where the analytic maps among these edits take a point. */
export const deformPoint = (point: Vec3, edits: Edit[]): Vec3 => mapsOf(edits).reduce((at, map) => forward(map)(...at), point);

/** The point that they take to `place`. */
export const undeformPoint = (place: Vec3, edits: Edit[]): Vec3 => mapsOf(edits).reduceRight((at, map) => inverse(map, at), place);

/** Moved points, three numbers each; the same array where no edit moves anything. */
export function deformPoints(points: Float32Array, edits: Edit[]): Float32Array {
  const maps = mapsOf(edits);
  if (maps.length === 0) return points;
  const result = points.slice();
  for (const map of maps) {
    const move = forward(map);
    for (let i = 0; i < result.length; i += 3) [result[i], result[i + 1], result[i + 2]] = move(result[i]!, result[i + 1]!, result[i + 2]!);
  }
  return result;
}

type PointMap = (x: number, y: number, z: number) => Vec3;

/** sin(t) / t. */
const sinc = (t: number) => (Math.abs(t) < 1e-6 ? 1 - (t * t) / 6 : Math.sin(t) / t);

function forward(map: AnalyticMap): PointMap {
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
      return latticeForward(map);
  }
}

function inverse(map: AnalyticMap, place: Vec3): Vec3 {
  const [x, y, z] = place;
  switch (map.type) {
    case 'twist':
      return forward({ type: 'twist', rate: -map.rate })(x, y, z);
    case 'bend': {
      const k = map.curvature;
      if (Math.abs(k) < 1e-9) return place;
      return [(1 - Math.hypot(k * z, 1 - k * x)) / k, y, Math.atan2(k * z, 1 - k * x) / k];
    }
    case 'stretch':
      return forward({ type: 'stretch', factor: 1 / map.factor })(x, y, z);
    case 'lattice':
      return solve(latticeForward(map), place, (map.maximum[2] - map.minimum[2]) * 1e-4);
  }
}

/** The point that `move` takes to `place`, by Newton's method from there; slopes are differences over `step`. */
function solve(move: PointMap, place: Vec3, step: number): Vec3 {
  let at = place;
  for (let round = 0; round < 20; round++) {
    const here = move(...at);
    const miss = place.map((value, axis) => value - here[axis]!) as Vec3;
    if (Math.hypot(...miss) < 1e-3 * step) break;
    const columns = [0, 1, 2].map((axis) => {
      const beside = move(...(at.map((value, k) => (k === axis ? value + step : value)) as Vec3));
      return beside.map((value, k) => (value - here[k]!) / step) as Vec3;
    }) as [Vec3, Vec3, Vec3];
    const volume = determinant(...columns);
    if (Math.abs(volume) < 1e-9) break; // flattened: no single point goes there
    at = at.map((value, axis) => value + determinant(...(columns.with(axis, miss) as [Vec3, Vec3, Vec3])) / volume) as Vec3;
  }
  return at;
}

const determinant = (a: Vec3, b: Vec3, c: Vec3) => a[0] * (b[1] * c[2] - b[2] * c[1]) - b[0] * (a[1] * c[2] - a[2] * c[1]) + c[0] * (a[1] * b[2] - a[2] * b[1]);

function latticeForward({ minimum, maximum, control_points: grid }: LatticeMap): PointMap {
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
