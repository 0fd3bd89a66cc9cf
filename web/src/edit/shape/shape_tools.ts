/** Tools of the Shape panel that work on the picture: handles, corners of the lattice, and the brush for what a simulation holds. */

import { computed, effect, signal } from '@preact/signals';
import { withReplaced } from '../../session/edit_list';
import { commitDraft, draftEdit, edits, reviseEdits } from '../../session/edit_log';
import { notify } from '../../session/notices';
import type { Edit, LatticeMap } from '../../session/protocol.gen';
import { openedAsset } from '../../session/session';
import { viewNow, type Vec3 } from '../../session/view';
import { newKey } from '../gestures';
import { bounds, mesh, objectRadius } from '../mesh';
import { deformPoint, undeformPoint, type AnalyticMap } from './deform_maps';
import { handlesOf, keyOf, MOST_HANDLES, movedTo, overruled, overrules, placeOf, restOf, withHandles, type Handle } from './handles';
import { adjusted, cornersOf, edgesOf, restLattice, withCorner, type Lattice } from './lattice';

export type ShapeTool = 'none' | 'handles' | 'lattice' | 'pins';
/** Whether the tools are at hand: written by the page, true while it shows the Shape panel. */
export const shapeToolsShown = signal(false);
const wanted = signal<ShapeTool>('none');
export const shapeTool = computed<ShapeTool>(() => (shapeToolsShown.value && openedAsset.value !== null ? wanted.value : 'none'));
/** Radius of new handles, as a share of the object's own. */
export const reach = signal(0.15);
/** Whether the gizmo turns what it holds, or moves it. */
export const gizmoMode = signal<'translate' | 'rotate'>('translate');

/** Something that the gizmo can take hold of: a handle, or a corner of the lattice. */
export interface Grabbable {
  key: string;
  /** Where it is seen [world units]. */
  place: Vec3;
  /** Rotation vector [degrees]; null: it cannot be turned. */
  turn: Vec3 | null;
  moved: boolean;
}

// ---- maps: twist, bend, stretch, lattice -----------------------------------------------------------------------------------

type MapType = AnalyticMap['type'];

const hasMap = (type: MapType) => (edit: Edit) => edit.op === 'deform' && edit.map?.type === type;

/** The newest map of a type that is in force; null where there is none. */
export function newestMap<T extends MapType>(type: T): Extract<AnalyticMap, { type: T }> | null {
  const edit = edits.value.findLast(hasMap(type));
  return edit?.op === 'deform' ? (edit.map as Extract<AnalyticMap, { type: T }>) : null;
}

/** Show a map in place of the newest one of its type; sent by `commitDraft`. */
export const draftMap = (map: AnalyticMap) => draftEdit({ op: 'deform', map }, hasMap(map.type));

export const removeMaps = (type: MapType) => reviseEdits((now) => now.filter((edit) => !hasMap(type)(edit)));

export const lattice = computed<LatticeMap | null>(() => newestMap('lattice'));
const shownLattice = () => lattice.value ?? restLattice(bounds.value);
/** What comes after the lattice moves its corners too. */
const behindLattice = computed(() => (lattice.value ? edits.value.slice(edits.value.findLastIndex(hasMap('lattice')) + 1) : []));

/** Whether an edit says where every vertex is: corners would be seen where they do nothing. */
export const latticeOverruled = computed(() => edits.value.some(overrules));

export const adjustLattice = (change: Partial<Lattice>) => draftMap(adjusted(shownLattice(), change));

const cornerKey = (number: number) => `corner ${number}`;
const cornerNumber = (key: string) => Number(key.replace('corner ', ''));

// ---- what can be taken hold of ---------------------------------------------------------------------------------------------

export const grabbables = computed<Grabbable[]>(() => {
  const positions = mesh.value?.positions;
  if (!positions) return [];
  switch (shapeTool.value) {
    case 'handles':
      if (overruled(edits.value)) return [];
      return handlesOf(edits.value).map((handle) => ({ key: keyOf(handle), place: placeOf(handle, edits.value, positions), turn: handle.turn, moved: handle.target !== null }));
    case 'lattice':
      if (latticeOverruled.value) return [];
      return cornersOf(shownLattice()).map(({ number, place, rest }) => ({
        key: cornerKey(number),
        place: deformPoint(place, behindLattice.value),
        turn: null,
        moved: place.some((value, axis) => value !== rest[axis]),
      }));
    default:
      return [];
  }
});
/** Pairs of grabbables that a line joins. */
export const joined = computed<[number, number][]>(() => (shapeTool.value === 'lattice' && grabbables.value.length ? edgesOf(shownLattice()) : []));

const chosenKey = signal<string | null>(null);
export const chosen = computed(() => grabbables.value.find(({ key }) => key === chosenKey.value) ?? null);
export const choose = (key: string | null) => void (chosenKey.value = key);

export function chooseShapeTool(next: ShapeTool): void {
  wanted.value = next;
  chosenKey.value = null;
}

effect(() => {
  openedAsset.value;
  chooseShapeTool('none');
});

// ---- what is done with it --------------------------------------------------------------------------------------------------

/** Put a handle on a point of the object at rest. It stays where it is until it is moved. */
export function putHandle(point: Vec3): void {
  if (overruled(edits.value)) return notify('What moves now says where everything is: remove it under Simulation first, then put handles.', 'info');
  if (handlesOf(edits.value).length >= MOST_HANDLES) return notify(`An object takes ${MOST_HANDLES} handles at most.`, 'info');
  const handle: Handle = { grip: { point, radius: reach.value * objectRadius.value }, target: null, turn: [0, 0, 0] };
  reviseEdits((now) => withHandles(now, [...handlesOf(now), handle]), newKey());
  chosenKey.value = keyOf(handle);
}

/** Put one where the object is nearest to the eye and has none yet. */
export function putHandleInFront(): void {
  const positions = mesh.value?.positions;
  const view = viewNow.value;
  if (!positions || !view) return;
  const eye = view.world_from_camera.slice(0, 3).map((row) => row[3]!);
  const taken = handlesOf(edits.value).map((handle) => ({ at: restOf(handle, positions), radius: 2 * Math.max(handle.grip.radius ?? 0, 0.1 * objectRadius.value) }));
  let best: Vec3 | null = null;
  let nearest = Infinity;
  for (let i = 0; i < positions.length; i += 3) {
    const rest: Vec3 = [positions[i]!, positions[i + 1]!, positions[i + 2]!];
    const distance = apart(deformPoint(rest, edits.value), eye);
    if (distance >= nearest || taken.some(({ at, radius }) => apart(at, rest) < radius)) continue;
    [best, nearest] = [rest, distance];
  }
  if (best) putHandle(best);
}

const apart = (a: number[], b: number[]) => Math.hypot(...a.map((value, axis) => value - b[axis]!));

/** Move something that is held. `gesture`: of the drag, which is one step of undo. A corner's is sent by `commitDraft`. */
export function moveGrabbed(key: string, place: Vec3, turn: Vec3, gesture: string): void {
  if (shapeTool.value === 'lattice') return draftMap(withCorner(shownLattice(), cornerNumber(key), undeformPoint(place, behindLattice.value)));
  changeHandle(key, (handle, now) => movedTo(handle, place, turn, now), gesture);
}

/** The hand lets go of what it held. */
export const letGo = commitDraft;

function changeHandle(key: string, change: (handle: Handle, now: Edit[]) => Handle, gesture = newKey()): void {
  reviseEdits((now) => withHandles(now, handlesOf(now).map((handle) => (keyOf(handle) === key ? change(handle, now) : handle))), gesture);
}

export const setReach = (key: string, radius: number, gesture: string) => changeHandle(key, (handle) => ({ ...handle, grip: { ...handle.grip, radius } }), gesture);

/** Back to where it was before it was moved. A handle then stays there. */
export function putBack(key: string): void {
  if (shapeTool.value !== 'lattice') return changeHandle(key, (handle) => ({ ...handle, target: null, turn: [0, 0, 0] }));
  const map = lattice.value;
  const corner = map && cornersOf(map).find(({ number }) => number === cornerNumber(key));
  if (corner) reviseEdits((now) => withReplaced(now, { op: 'deform', map: withCorner(map, corner.number, corner.rest) }, hasMap('lattice')));
}

/** The Delete key: a handle goes, a corner goes back. */
export function removeChosen(): void {
  const grabbed = chosen.value;
  if (!grabbed) return;
  if (shapeTool.value === 'lattice') return putBack(grabbed.key);
  reviseEdits((now) => withHandles(now, handlesOf(now).filter((handle) => keyOf(handle) !== grabbed.key)), newKey());
  chosenKey.value = null;
}

export const removeHandles = () => reviseEdits((now) => withHandles(now, []));
