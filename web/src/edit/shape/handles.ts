/** Handles of an edit, as the gizmo and the panel show them: which part each holds, and whether it stays or where it went. */

import { withReplaced } from '../../session/edit_list';
import type { Edit, Grip } from '../../session/protocol.gen';
import type { Vec3 } from '../../session/view';
import { deformPoint, undeformPoint } from './deform_maps';

export interface Handle {
  /** The part of the object at rest that it holds. */
  grip: Grip;
  /** Where its point was moved to [world units]; null: it stays where the other edits put it. */
  target: Vec3 | null;
  /** Rotation vector [degrees]. */
  turn: Vec3;
}

export const MOST_HANDLES = 64;
const NO_TURN: Vec3 = [0, 0, 0];

/** Names a handle whatever is done with it. */
export const keyOf = ({ grip }: Handle) => JSON.stringify(grip.point ?? grip.vertices);

const holds = (edit: Edit) => edit.op === 'deform' && edit.handles != null;
/** These edits say where every vertex is, whatever handles did before. */
export const overrules = (edit: Edit) => edit.op === 'pose' || edit.op === 'simulate' || (edit.op === 'deform' && edit.vertices != null);

/** Whether the handles in force, or new ones, do nothing. */
export const overruled = (edits: Edit[]) => edits.findLastIndex(overrules) > edits.findLastIndex(holds);

/** The handles of the newest edit that has some: first those that were moved, then those that stay. */
export function handlesOf(edits: Edit[]): Handle[] {
  const edit = edits.findLast(holds);
  if (edit?.op !== 'deform' || !edit.handles) return [];
  const { drag = [], pin = [] } = edit.handles;
  const grip = ({ vertices, point, radius }: Grip): Grip => (point ? { point, radius: radius ?? 0 } : { vertices });
  return [...drag.map((part) => ({ grip: grip(part), target: part.target, turn: part.turn ?? NO_TURN })), ...pin.map((part) => ({ grip: grip(part), target: null, turn: NO_TURN }))];
}

/** The edits with these handles in place of those of the newest edit that has some; without any, that edit goes. */
export function withHandles(edits: Edit[], handles: Handle[]): Edit[] {
  if (handles.length === 0) return edits.filter((edit, i) => !holds(edit) || i !== edits.findLastIndex(holds));
  const drag = handles.flatMap(({ grip, target, turn }) => (target ? [{ ...grip, target, turn }] : []));
  const pin = handles.flatMap(({ grip, target }) => (target ? [] : [grip]));
  return withReplaced(edits, { op: 'deform', handles: { drag, pin } }, holds);
}

/** The handle's point on the object at rest; of several vertices, their middle. */
export function restOf({ grip }: Handle, positions: Float32Array): Vec3 {
  if (grip.point) return grip.point;
  const vertices = grip.vertices ?? [];
  return [0, 1, 2].map((axis) => vertices.reduce((sum, vertex) => sum + positions[3 * vertex + axis]!, 0) / vertices.length) as Vec3;
}

/** What moves the handles after their own edit has. */
const behind = (edits: Edit[]) => edits.slice(edits.findLastIndex(holds) + 1);

/** Where the handle is seen now. */
export const placeOf = (handle: Handle, edits: Edit[], positions: Float32Array): Vec3 => (handle.target ? deformPoint(handle.target, behind(edits)) : deformPoint(restOf(handle, positions), edits));

/** The handle moved to where it is to be seen. Before there is an edit with handles, its own will come behind all others. */
export const movedTo = (handle: Handle, place: Vec3, turn: Vec3, edits: Edit[]): Handle => ({ ...handle, target: edits.some(holds) ? undeformPoint(place, behind(edits)) : place, turn });

/** Rotation vector [degrees] of a unit quaternion: of the two that it may mean, the shorter. */
export function turnFromQuatXyzw([x, y, z, w]: [number, number, number, number]): Vec3 {
  const sine = Math.hypot(x, y, z);
  if (sine < 1e-12) return [0, 0, 0];
  const degrees = (2 * Math.atan2(sine, Math.abs(w)) * 180) / Math.PI;
  return [x, y, z].map((value) => (Math.sign(w || 1) * value * degrees) / sine) as Vec3;
}

export function quatXyzwFromTurn(turn: Vec3): [number, number, number, number] {
  const degrees = Math.hypot(...turn);
  if (degrees < 1e-12) return [0, 0, 0, 1];
  const half = (degrees * Math.PI) / 360;
  const [x, y, z] = turn.map((value) => (value / degrees) * Math.sin(half));
  return [x!, y!, z!, Math.cos(half)];
}
