/** The box of a build, in the world that is turned so that up is z: as it was found, and with its sides moved. The server cuts by the same numbers. */

import type { BoxCorners, CaptureLook } from '../session/protocol.gen';
import type { Vec3 } from '../session/view';

/** Of the box's diagonal: nearer to each other no two sides come. */
const THINNEST = 0.01;
/** Of the diagonal: how far a key moves a side. */
const STEP = 0.01;

export type Rows = [Vec3, Vec3, Vec3];

/** A side: its axis, and whether it is the one with the larger coordinate. */
export interface Side {
  axis: 0 | 1 | 2;
  high: boolean;
}

export const SIDES: Side[] = ([0, 1, 2] as const).flatMap((axis) => [{ axis, high: false }, { axis, high: true }]);
export const sideName = ({ axis, high }: Side) => `${high ? '+' : '−'}${'xyz'[axis]}`;

/** The smallest rotation that takes a direction to z; half a turn goes around x. As `rotation_to_up` of drgs/reconstruct/capture/turn_up.py. */
export function rotationToUp(up: Vec3): Rows {
  const length = Math.hypot(...up);
  const [x, y, z] = up.map((value) => value / length) as Vec3;
  if (z < -1 + 1e-6) return x === 0 && y === 0 ? [[1, 0, 0], [0, -1, 0], [0, 0, -1]] : aroundX(rotationToUp([x, -y, -z]));
  const s = 1 / (1 + z);
  return [
    [1 - s * x * x, -s * x * y, -x],
    [-s * x * y, 1 - s * y * y, -y],
    [x, y, z],
  ];
}

/** Half a turn around x, before a rotation. */
const aroundX = (rows: Rows) => rows.map(([x, y, z]) => [x, -y, -z]) as Rows;

export const turned = (rows: Rows, [x, y, z]: Vec3) => rows.map((row) => row[0] * x + row[1] * y + row[2] * z) as Vec3;
export const turnedBack = (rows: Rows, place: Vec3) => ([0, 1, 2] as const).map((axis) => rows.reduce((sum, row, k) => sum + row[axis] * place[k]!, 0)) as Vec3;

/** What a build takes that is told no box: about the hull of the masks; about cameras' common sight where there are none. Null without cameras. */
export function foundBox(look: CaptureLook, up: Vec3): BoxCorners | null {
  const { box_low: low, box_high: high, outermost = [] } = look;
  if (!low || !high) return null;
  const rows = rotationToUp(up);
  if (outermost.length === 0) {
    const center = turned(rows, low.map((value, axis) => (value + high[axis]!) / 2) as Vec3);
    const half = low.map((value, axis) => (high[axis]! - value) / 2);
    return { low: center.map((value, axis) => value - half[axis]!) as Vec3, high: center.map((value, axis) => value + half[axis]!) as Vec3 };
  }
  const places = Array.from({ length: outermost.length / 3 }, (_, k) => turned(rows, outermost.slice(3 * k, 3 * k + 3) as Vec3));
  const extreme = (of: (...values: number[]) => number) => ([0, 1, 2] as const).map((axis) => of(...places.map((place) => place[axis]))) as Vec3;
  return { low: extreme(Math.min), high: extreme(Math.max) };
}

export const diagonalOf = ({ low, high }: BoxCorners) => Math.hypot(...low.map((value, axis) => high[axis]! - value));
export const stepOf = (found: BoxCorners) => STEP * diagonalOf(found);
export const centerOf = ({ low, high }: BoxCorners) => low.map((value, axis) => (value + high[axis]!) / 2) as Vec3;
export const valueOf = (box: BoxCorners, { axis, high }: Side) => (high ? box.high : box.low)[axis];

/** The middle of a side. */
export const sideCenter = (box: BoxCorners, side: Side) => centerOf(box).with(side.axis, valueOf(box, side)) as Vec3;

/** The box with a side elsewhere, before the one across. `found`: whose size says what is too thin. */
export function withSide(box: BoxCorners, { axis, high }: Side, to: number, found: BoxCorners): BoxCorners {
  const least = THINNEST * diagonalOf(found);
  if (high) return { low: box.low, high: box.high.with(axis, Math.max(to, box.low[axis] + least)) as Vec3 };
  return { low: box.low.with(axis, Math.min(to, box.high[axis] - least)) as Vec3, high: box.high };
}
