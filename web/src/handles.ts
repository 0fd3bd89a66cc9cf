/** Handles of an edit, as the gizmo and the panel show them: which part each holds, whether it stays or where it went. No signals, no three.js. */

import type { Triple } from './color';
import { withReplaced } from './edit_log';
import type { Edit, Grip } from './protocol.gen';
import { movePoint, unmovePoint } from './shape';

export interface HeldPart {
  grip: Grip;
  /** Where its point was taken [world units]; null: it stays where the other edits put it. */
  target: Triple | null;
  /** Rotation vector [degrees]. */
  turn: Triple;
}

export const MOST_HANDLES = 64;
const NO_TURN: Triple = [0, 0, 0];

/** The same for one handle whatever is done with it. */
export const keyOf = ({ grip }: HeldPart) => JSON.stringify(grip.point ?? grip.vertices);

const holds = (edit: Edit) => edit.op === 'deform' && edit.handles != null;
/** Those say where everything is, whatever handles did before. */
const overrules = (edit: Edit) => edit.op === 'pose' || edit.op === 'simulate' || (edit.op === 'deform' && edit.vertices != null);

/** Whether handles that are put now would do nothing. */
export const overruled = (edits: Edit[]) => edits.findLastIndex(overrules) > edits.findLastIndex(holds);

/** Those of the newest edit that has some: first what was moved, then what stays. */
export function handlesOf(edits: Edit[]): HeldPart[] {
  const edit = edits.findLast(holds);
  if (edit?.op !== 'deform' || !edit.handles) return [];
  const { drag = [], pin = [] } = edit.handles;
  const grip = ({ vertices, point, radius }: Grip): Grip => (point ? { point, radius: radius ?? 0 } : { vertices });
  return [...drag.map((part) => ({ grip: grip(part), target: part.target, turn: part.turn ?? NO_TURN })), ...pin.map((part) => ({ grip: grip(part), target: null, turn: NO_TURN }))];
}

/** The edits with these handles in place of those of the newest edit that has some; without any, that edit goes. */
export function withHandles(edits: Edit[], parts: HeldPart[]): Edit[] {
  if (parts.length === 0) return edits.filter((edit, i) => !holds(edit) || i !== edits.findLastIndex(holds));
  const drag = parts.flatMap(({ grip, target, turn }) => (target ? [{ ...grip, target, turn }] : []));
  const pin = parts.flatMap(({ grip, target }) => (target ? [] : [grip]));
  return withReplaced(edits, { op: 'deform', handles: { drag, pin } }, holds);
}

/** Its point on the object at rest; of several vertices, their middle. */
export function restOf({ grip }: HeldPart, positions: Float32Array): Triple {
  if (grip.point) return grip.point;
  const vertices = grip.vertices ?? [];
  return [0, 1, 2].map((axis) => vertices.reduce((sum, vertex) => sum + positions[3 * vertex + axis]!, 0) / vertices.length) as Triple;
}

const behind = (edits: Edit[]) => edits.slice(edits.findLastIndex(holds) + 1);

/** Where it is seen now. */
export const placeOf = (part: HeldPart, edits: Edit[], positions: Float32Array): Triple => (part.target ? movePoint(part.target, behind(edits)) : movePoint(restOf(part, positions), edits));

/** Taken to where it is to be seen. Those that the newest edit has none of yet lie behind all edits. */
export const movedTo = (part: HeldPart, place: Triple, turn: Triple, edits: Edit[]): HeldPart => ({ ...part, target: edits.some(holds) ? unmovePoint(place, behind(edits)) : place, turn });

/** A rotation vector in degrees from a unit quaternion (x, y, z, w); of the two turns that it may mean, the shorter. */
export function turnOfQuaternion([x, y, z, w]: [number, number, number, number]): Triple {
  const sine = Math.hypot(x, y, z);
  if (sine < 1e-12) return [0, 0, 0];
  const degrees = (2 * Math.atan2(sine, Math.abs(w)) * 180) / Math.PI;
  return [x, y, z].map((value) => (Math.sign(w || 1) * value * degrees) / sine) as Triple;
}

export function quaternionOfTurn(turn: Triple): [number, number, number, number] {
  const degrees = Math.hypot(...turn);
  if (degrees < 1e-12) return [0, 0, 0, 1];
  const half = (degrees * Math.PI) / 360;
  const [x, y, z] = turn.map((value) => (value / degrees) * Math.sin(half));
  return [x!, y!, z!, Math.cos(half)];
}
