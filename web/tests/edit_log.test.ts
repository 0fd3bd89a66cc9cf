import { describe, expect, it } from 'vitest';
import { describeEdit, difference, factorOf, isSet, lightOf, sameEdits, withoutValue, withReplaced } from '../src/edit_log';
import type { Edit, Selection } from '../src/protocol.gen';

const all: Selection = { all: true };
/** As the server sends a selection back: everything that it does not say is null. */
const fromServer = (select: Selection): Selection => ({ all: null, sphere: null, box: null, region: null, similar: null, vertex_weights: null, ...select });
const rough = (roughness: number, select = all, mode: 'absolute' | 'multiply' = 'absolute'): Edit => ({ op: 'material', select, set: { roughness }, mode });
const sphere: Selection = { sphere: { center: [0, 0, 0.5], radius: 0.2 } };

describe('taking a value back', () => {
  it('removes what set it and leaves the rest in order', () => {
    const edits: Edit[] = [rough(0.1), { op: 'environment', file: 'a.exr' }, { op: 'material', select: all, set: { roughness: 0.2, metallic: 1 } }, rough(0.9, sphere)];
    const rest = withoutValue(edits, all, 'roughness');
    expect(rest).toEqual([edits[1], { op: 'material', select: all, set: { albedo: undefined, metallic: 1 } }, edits[3]]);
    expect(isSet(rest, all, 'roughness')).toBe(false);
    expect(isSet(rest, sphere, 'roughness')).toBe(true);
  });

  it('knows an edit to which the server added defaults, but not another kind of deformation', () => {
    const twist: Edit = { op: 'deform', map: { type: 'twist', rate: 1 } };
    const echoed = { ...twist, vertices: null, time: 0 } as Edit;
    expect(sameEdits([twist], [echoed])).toBe(true);
    expect(sameEdits([twist], [{ ...echoed, map: null, vertices: 'a.npz' } as Edit])).toBe(false);
    expect(sameEdits([twist], [{ op: 'deform', map: { type: 'twist', rate: 2 } }])).toBe(false);
    expect(sameEdits([twist], [twist, twist])).toBe(false);
  });

  it('knows a selection that came back from the server', () => {
    const echoed = rough(0.9, fromServer({ sphere: { center: [0, 0, 0.5], radius: 0.2, falloff: 0 } }));
    expect(withoutValue([echoed], sphere, 'roughness')).toEqual([]);
    expect(sameEdits([echoed], [rough(0.9, sphere)])).toBe(true);
    expect(sameEdits([rough(0.9)], [rough(0.8)])).toBe(false);
  });
});

it('a factor is the newest multiplying edit of that very selection', () => {
  const edits = [rough(2, all, 'multiply'), rough(3, sphere, 'multiply'), rough(0.5)];
  expect(factorOf(edits, all, 'roughness')).toBe(2);
  expect(factorOf(edits, sphere, 'roughness')).toBe(3);
  expect(factorOf(edits, all, 'metallic')).toBe(null);
});

it('an edit takes the place of the newest one that it replaces', () => {
  const twist = (rate: number): Edit => ({ op: 'deform', map: { type: 'twist', rate } });
  const isTwist = (edit: Edit) => edit.op === 'deform';
  expect(withReplaced([twist(1), rough(0.1)], twist(2), isTwist)).toEqual([twist(2), rough(0.1)]);
  expect(withReplaced([rough(0.1)], twist(2), isTwist)).toEqual([rough(0.1), twist(2)]);
});

it('an environment edit without a file keeps the one in force', () => {
  expect(lightOf([{ op: 'environment', file: 'a.exr', rotation: 10 }, { op: 'environment', intensity: 2 }])).toEqual({ file: 'a.exr', rotation: 0, intensity: 2 });
  expect(lightOf([])).toEqual({ file: null, rotation: 0, intensity: 1 });
});

it('history names presets and parts', () => {
  expect(describeEdit({ op: 'material', select: fromServer({ region: 2 }), set: { albedo: [1.0, 0.766, 0.336], roughness: 0.2, metallic: 1 } })).toBe('Region: gold');
  expect(describeEdit(rough(0.25))).toBe('Roughness 0.25');
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
