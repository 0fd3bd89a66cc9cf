import { expect, it } from 'vitest';
import type { Vec3 } from '../../../src/session/view';
import { handlesOf, keyOf, movedTo, overruled, placeOf, quatXyzwFromTurn, turnFromQuatXyzw, withHandles, type Handle } from '../../../src/edit/shape/handles';
import type { Edit } from '../../../src/session/protocol.gen';

const positions = Float32Array.from([0, 0, 0, 2, 0, 0, 0, 4, 0]);
const at = (...point: Vec3): Handle => ({ grip: { point, radius: 0.1 }, target: null, turn: [0, 0, 0] });
const stretch: Edit = { op: 'deform', map: { type: 'stretch', factor: 4 } };
const twist: Edit = { op: 'deform', map: { type: 'twist', rate: Math.PI / 2 } };
const close = (found: number[], wanted: number[]) => wanted.forEach((value, i) => expect(found[i]).toBeCloseTo(value, 6));

it('handles put on the object are an edit that only pins, and can be read back', () => {
  const after = withHandles([stretch], [at(0, 0, 1), at(0, 0, -1)]);
  expect(after).toEqual([stretch, { op: 'deform', handles: { drag: [], pin: [{ point: [0, 0, 1], radius: 0.1 }, { point: [0, 0, -1], radius: 0.1 }] } }]);
  expect(handlesOf(after)).toEqual([at(0, 0, 1), at(0, 0, -1)]);
});

it('a moved handle keeps its key, goes in front of those that stay, and the edit keeps its place', () => {
  const before = withHandles([], [at(0, 0, 1), at(0, 0, -1)]);
  const now = [...before, twist];
  const [first, second] = handlesOf(now) as [Handle, Handle];
  const after = withHandles(now, [first, movedTo(second, [0, 0, -2], [0, 0, 90], now)]);
  expect(after[0]).toMatchObject({ op: 'deform', handles: { drag: [{ point: [0, 0, -1], turn: [0, 0, 90] }], pin: [{ point: [0, 0, 1] }] } });
  expect(after[1]).toBe(twist);
  expect(handlesOf(after).map(keyOf)).toEqual([keyOf(second), keyOf(first)]);
});

it('a handle is seen where the edits before and behind its own put it', () => {
  const part = at(1, 0, 1);
  close(placeOf(part, [stretch, ...withHandles([], [part])], positions), [0.5, 0, 4]);
  const moved: Handle = { ...part, target: [1, 0, 1] };
  close(placeOf(moved, [stretch, ...withHandles([], [moved]), twist], positions), [0, 1, 1]);
});

it('a handle is taken to the place where it is seen, whatever edits come behind', () => {
  const edits = [...withHandles([], [at(1, 0, 1)]), twist, stretch];
  const moved = movedTo(handlesOf(edits)[0]!, [0.3, -0.2, 0.7], [0, 0, 0], edits);
  close(placeOf(moved, edits, positions), [0.3, -0.2, 0.7]);
});

it('a script’s handle on vertices is seen in their middle and kept as it is', () => {
  const edits: Edit[] = [{ op: 'deform', handles: { drag: [{ vertices: [1], target: [9, 9, 9] }], pin: [{ vertices: [0, 1, 2] }] } }];
  const [dragged, pinned] = handlesOf(edits) as [Handle, Handle];
  close(placeOf(pinned, edits, positions), [2 / 3, 4 / 3, 0]);
  close(placeOf(dragged, edits, positions), [9, 9, 9]);
  expect(withHandles(edits, [dragged, pinned])).toEqual([{ op: 'deform', handles: { drag: [{ vertices: [1], target: [9, 9, 9], turn: [0, 0, 0] }], pin: [{ vertices: [0, 1, 2] }] } }]);
});

it('without handles their edit goes, and no other', () => {
  expect(withHandles([stretch, ...withHandles([], [at(0, 0, 1)]), twist], [])).toEqual([stretch, twist]);
});

it('what says where everything is overrules handles that come before it', () => {
  const film: Edit = { op: 'simulate', scene: {}, time: 1 };
  expect(overruled([...withHandles([], [at(0, 0, 1)]), film])).toBe(true);
  expect(overruled([film, ...withHandles([], [at(0, 0, 1)])])).toBe(false);
  expect(overruled([film])).toBe(true);
});

it('turns go to quaternions and back, the short way', () => {
  for (const turn of [[0, 0, 0], [0, 0, 90], [30, -60, 45], [0, 170, 0]] as Vec3[]) close(turnFromQuatXyzw(quatXyzwFromTurn(turn)), turn);
  const [x, y, z, w] = quatXyzwFromTurn([0, 0, 200]);
  close(turnFromQuatXyzw([x, y, z, w]), [0, 0, -160]);
});
