import { expect, it } from 'vitest';
import { difference, sameEdits, sameSelection, withReplaced } from '../../src/session/edit_list';
import type { Edit, Selection } from '../../src/session/protocol.gen';

/** As the server sends a selection back: everything that it does not say is null. */
const fromServer = (select: Selection): Selection => ({ all: null, sphere: null, box: null, region: null, similar: null, vertex_weights: null, ...select });
const rough = (roughness: number, select: Selection = { all: true }): Edit => ({ op: 'material', select, set: { roughness }, mode: 'absolute' });
const sphere: Selection = { sphere: { center: [0, 0, 0.5], radius: 0.2 } };

it('an edit is the same once the server has added defaults, but not as another kind of deformation', () => {
  const twist: Edit = { op: 'deform', map: { type: 'twist', rate: 1 } };
  const echoed = { ...twist, vertices: null, time: 0 } as Edit;
  expect(sameEdits([twist], [echoed])).toBe(true);
  expect(sameEdits([twist], [{ ...echoed, map: null, vertices: 'a.npz' } as Edit])).toBe(false);
  expect(sameEdits([twist], [{ op: 'deform', map: { type: 'twist', rate: 2 } }])).toBe(false);
  expect(sameEdits([twist], [twist, twist])).toBe(false);
});

it('a selection is the same when it comes back from the server', () => {
  const echoed = fromServer({ sphere: { center: [0, 0, 0.5], radius: 0.2, falloff: 0 } });
  expect(sameSelection(echoed, sphere)).toBe(true);
  expect(sameEdits([rough(0.9, echoed)], [rough(0.9, sphere)])).toBe(true);
  expect(sameEdits([rough(0.9)], [rough(0.8)])).toBe(false);
});

it('an edit takes the place of the newest one that it replaces', () => {
  const twist = (rate: number): Edit => ({ op: 'deform', map: { type: 'twist', rate } });
  const isTwist = (edit: Edit) => edit.op === 'deform';
  expect(withReplaced([twist(1), rough(0.1)], twist(2), isTwist)).toEqual([twist(2), rough(0.1)]);
  expect(withReplaced([rough(0.1)], twist(2), isTwist)).toEqual([rough(0.1), twist(2)]);
});

it('finds what has to be exchanged between two lists of edits', () => {
  const edit = (rotation: number): Edit => ({ op: 'environment', rotation });
  const list = (...rotations: number[]) => rotations.map(edit);
  expect(difference(list(1, 2, 3), list(1, 4, 5, 3))).toEqual({ start: 1, remove: 1, edits: list(4, 5) });
  expect(difference(list(1, 2), list(1, 2))).toEqual({ start: 2, remove: 0, edits: [] });
  expect(difference(list(1, 1, 1), list(1, 1))).toEqual({ start: 2, remove: 1, edits: [] });
  expect(difference(list(), list(7))).toEqual({ start: 0, remove: 0, edits: list(7) });
  expect(difference(list(7, 8), list())).toEqual({ start: 0, remove: 2, edits: [] });
});
