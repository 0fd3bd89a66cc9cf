import { expect, it } from 'vitest';
import { factorOf, isSet, withoutValue } from '../../../src/edit/material/values';
import type { Edit, Selection } from '../../../src/session/protocol.gen';

const all: Selection = { all: true };
/** As the server sends a selection back: everything that it does not say is null. */
const fromServer = (select: Selection): Selection => ({ all: null, sphere: null, box: null, region: null, similar: null, vertex_weights: null, ...select });
const rough = (roughness: number, select = all, mode: 'absolute' | 'multiply' = 'absolute'): Edit => ({ op: 'material', select, set: { roughness }, mode });
const sphere: Selection = { sphere: { center: [0, 0, 0.5], radius: 0.2 } };

it('taking a value back removes what set it and leaves the rest in order', () => {
  const edits: Edit[] = [rough(0.1), { op: 'environment', file: 'a.exr' }, { op: 'material', select: all, set: { roughness: 0.2, metallic: 1 } }, rough(0.9, sphere)];
  const rest = withoutValue(edits, all, 'roughness');
  expect(rest).toEqual([edits[1], { op: 'material', select: all, set: { albedo: undefined, metallic: 1 } }, edits[3]]);
  expect(isSet(rest, all, 'roughness')).toBe(false);
  expect(isSet(rest, sphere, 'roughness')).toBe(true);
});

it('a value is taken back from a selection that came from the server', () => {
  const echoed = rough(0.9, fromServer({ sphere: { center: [0, 0, 0.5], radius: 0.2, falloff: 0 } }));
  expect(withoutValue([echoed], sphere, 'roughness')).toEqual([]);
});

it('a factor is the newest multiplying edit of that very selection', () => {
  const edits = [rough(2, all, 'multiply'), rough(3, sphere, 'multiply'), rough(0.5)];
  expect(factorOf(edits, all, 'roughness')).toBe(2);
  expect(factorOf(edits, sphere, 'roughness')).toBe(3);
  expect(factorOf(edits, all, 'metallic')).toBe(null);
});
