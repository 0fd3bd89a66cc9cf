/** Tools of the Shape panel that work on the picture: handles, corners of the lattice, and the brush for what a simulation holds. */

import { computed, effect, signal } from '@preact/signals';
import type { Triple } from './color';
import { handlesOf, keyOf, MOST_HANDLES, movedTo, overruled, placeOf, restOf, withHandles, type HeldPart } from './handles';
import { adjusted, cornersOf, edgesOf, restLattice, withCorner, type Lattice } from './lattice';
import { withReplaced } from './edit_log';
import type { Edit, LatticeMap } from './protocol.gen';
import { forgetPins } from './pins';
import { objectRadius } from './selecting';
import { changeFlowing, commitDraft, draftEdit, isTwin, newKey, replaceEdits } from './session';
import { boundsOf, movePoint, unmovePoint } from './shape';
import { edits, mesh, notify, session, tab } from './state';
import { viewNow } from './viewpoint';

export type ShapeTool = 'none' | 'handles' | 'lattice' | 'pins';
const wanted = signal<ShapeTool>('none');
export const shapeTool = computed<ShapeTool>(() => (tab.value === 'shape' && session.value ? wanted.value : 'none'));
/** Radius of new handles, as a share of the object's own. */
export const reach = signal(0.15);
export const turning = signal(false);

/** Something that the gizmo can take hold of. */
export interface Grabbable {
  key: string;
  place: Triple;
  /** Null: it has no turn. */
  turn: Triple | null;
  moved: boolean;
}

const holdsShape = (edit: Edit) => edit.op === 'pose' || edit.op === 'simulate' || (edit.op === 'deform' && edit.vertices != null);
export const bounds = computed(() => boundsOf(mesh.value?.positions ?? new Float32Array(3)));
export const handles = computed<HeldPart[]>(() => handlesOf(edits.value));
const latticeEdit = computed(() => edits.value.findLastIndex((edit) => edit.op === 'deform' && edit.map?.type === 'lattice'));
export const lattice = computed<LatticeMap | null>(() => {
  const edit = edits.value[latticeEdit.value];
  return edit?.op === 'deform' ? (edit.map as LatticeMap) : null;
});
/** What comes after it moves its corners too. */
const behindLattice = computed(() => (latticeEdit.value < 0 ? [] : edits.value.slice(latticeEdit.value + 1)));

/** Something else says where everything is, so corners would have to be seen where they do nothing. */
export const latticeOverruled = computed(() => edits.value.some(holdsShape));

export const grabbables = computed<Grabbable[]>(() => {
  const positions = mesh.value?.positions;
  if (!positions) return [];
  switch (shapeTool.value) {
    case 'handles':
      if (overruled(edits.value)) return [];
      return handles.value.map((part) => ({ key: keyOf(part), place: placeOf(part, edits.value, positions), turn: part.turn, moved: part.target !== null }));
    case 'lattice':
      if (latticeOverruled.value) return [];
      return cornersOf(lattice.value ?? restLattice(bounds.value)).map(({ number, place, rest }) => ({
        key: `corner ${number}`,
        place: movePoint(place, behindLattice.value),
        turn: null,
        moved: place.some((value, axis) => value !== rest[axis]),
      }));
    default:
      return [];
  }
});
/** Pairs of grabbables that a line joins. */
export const joined = computed<[number, number][]>(() => (shapeTool.value === 'lattice' && grabbables.value.length ? edgesOf(lattice.value ?? restLattice(bounds.value)) : []));

const chosenKey = signal<string | null>(null);
export const chosen = computed(() => grabbables.value.find(({ key }) => key === chosenKey.value) ?? null);
export const choose = (key: string | null) => void (chosenKey.value = key);

export function chooseShapeTool(next: ShapeTool): void {
  wanted.value = next;
  chosenKey.value = null;
}

effect(() => {
  session.value?.asset;
  chooseShapeTool('none');
  forgetPins();
});

// ---- what is done with it -----------------------------------------------------------------------------------------------

/** Put a handle on a point of the object at rest. It stays where it is until it is moved. */
export function putHandle(point: Triple): void {
  if (overruled(edits.value)) return notify('What moves now says where everything is: remove it under Simulation first, then put handles.', 'info');
  if (handles.value.length >= MOST_HANDLES) return notify(`An object takes ${MOST_HANDLES} handles at most.`, 'info');
  const part: HeldPart = { grip: { point, radius: reach.value * objectRadius.value }, target: null, turn: [0, 0, 0] };
  changeFlowing((now) => withHandles(now, [...handlesOf(now), part]), newKey());
  chosenKey.value = keyOf(part);
}

/** Put one where the object is nearest to the eye and has none yet. */
export function putHandleInFront(): void {
  const positions = mesh.value?.positions;
  const view = viewNow.value;
  if (!positions || !view) return;
  const eye = view.world_from_camera.slice(0, 3).map((row) => row[3]!);
  const taken = handles.value.map((part) => ({ at: restOf(part, positions), radius: 2 * Math.max(part.grip.radius ?? 0, 0.1 * objectRadius.value) }));
  let best: Triple | null = null;
  let nearest = Infinity;
  for (let i = 0; i < positions.length; i += 3) {
    const rest: Triple = [positions[i]!, positions[i + 1]!, positions[i + 2]!];
    const distance = apart(movePoint(rest, edits.value), eye);
    if (distance >= nearest || taken.some(({ at, radius }) => apart(at, rest) < radius)) continue;
    [best, nearest] = [rest, distance];
  }
  if (best) putHandle(best);
}

const apart = (a: number[], b: number[]) => Math.hypot(...a.map((value, axis) => value - b[axis]!));

/** Take one somewhere else. `gesture`: of the drag, which is one step of undo. */
export function moveGrabbed(key: string, place: Triple, turn: Triple, gesture: string): void {
  if (shapeTool.value === 'lattice') {
    const map = withCorner(lattice.value ?? restLattice(bounds.value), cornerNumber(key), unmovePoint(place, behindLattice.value));
    return draftLattice(map);
  }
  changeHandle(key, (part, now) => movedTo(part, place, turn, now), gesture);
}

/** The hand lets go. */
export const letGo = commitDraft;

export function draftLattice(map: LatticeMap): void {
  const edit: Edit = { op: 'deform', map };
  draftEdit(edit, isTwin(edit));
}

export const adjustLattice = (change: Partial<Lattice>) => draftLattice(adjusted(lattice.value ?? restLattice(bounds.value), change));

const cornerNumber = (key: string) => Number(key.replace('corner ', ''));

function changeHandle(key: string, change: (part: HeldPart, now: Edit[]) => HeldPart, gesture = newKey()): void {
  changeFlowing((now) => withHandles(now, handlesOf(now).map((part) => (keyOf(part) === key ? change(part, now) : part))), gesture);
}

export const setReach = (key: string, radius: number, gesture: string) => changeHandle(key, (part) => ({ ...part, grip: { ...part.grip, radius } }), gesture);

/** To where it was before it was moved: a handle then stays there, a corner too. */
export function putBack(key: string): void {
  if (shapeTool.value === 'lattice') {
    const map = lattice.value;
    const corner = map && cornersOf(map).find(({ number }) => number === cornerNumber(key));
    if (!corner) return;
    const edit: Edit = { op: 'deform', map: withCorner(map, corner.number, corner.rest) };
    return replaceEdits(withReplaced(edits.value, edit, isTwin(edit)));
  }
  changeHandle(key, (part) => ({ ...part, target: null, turn: [0, 0, 0] }));
}

/** The Delete key: a handle goes, a corner goes back. */
export function removeChosen(): void {
  const grabbed = chosen.value;
  if (!grabbed) return;
  if (shapeTool.value === 'lattice') return putBack(grabbed.key);
  changeFlowing((now) => withHandles(now, handlesOf(now).filter((part) => keyOf(part) !== grabbed.key)), newKey());
  chosenKey.value = null;
}

export const removeHandles = () => replaceEdits(withHandles(edits.value, []));
