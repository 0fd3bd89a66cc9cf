import { expect, it, vi } from 'vitest';
import { addVariant, applyVariant, AS_CAPTURED, removeVariant, renameVariant, variantMaterials, variants, variantShown, variantsOf } from '../../../src/edit/material/variants';
import { mesh } from '../../../src/edit/mesh';
import { difference } from '../../../src/session/edit_list';
import { attachStream, draft, log, resetLog } from '../../../src/session/edit_log';
import { notices } from '../../../src/session/notices';
import type { Edit, MaterialEdit } from '../../../src/session/protocol.gen';
import type { Stream } from '../../../src/session/stream';
import { strip } from './strip';

const rough = (roughness: number): MaterialEdit => ({ op: 'material', select: { all: true }, set: { roughness }, mode: 'absolute' });
const light: Edit = { op: 'environment', rotation: 30, intensity: 1 };
const variant = (name: string, ...edits: MaterialEdit[]): Edit => ({ op: 'variant', name, edits });

/** With these edits in force, and a server that has not answered yet: what it is asked for is the draft. */
function inForce(...edits: Edit[]): void {
  attachStream({ idle: true, splice: vi.fn(() => 1), sendEdit: vi.fn(() => 1) } as unknown as Stream);
  resetLog({ ...log.value, edits });
}

it('what is shown is kept under the first free name, and is then the variant that is in force', () => {
  inForce(variant('Variant 1', rough(0.9)), rough(0.2), light);
  expect(variantShown.value).toBe(null);
  addVariant();
  expect(draft.value).toEqual([variant('Variant 1', rough(0.9)), rough(0.2), light, variant('Variant 2', rough(0.2))]);
  expect(variants.value.map(({ name }) => name)).toEqual(['Variant 1', 'Variant 2']);
  expect(variantShown.value).toBe('Variant 2');
});

it('a variant takes the place of all material edits, and what is captured of them leaves none; light stays', () => {
  inForce(rough(0.2), light, variant('Matt', rough(0.9), rough(0.8)));
  applyVariant('Matt');
  expect(draft.value).toEqual([light, variant('Matt', rough(0.9), rough(0.8)), rough(0.9), rough(0.8)]);
  expect(variantShown.value).toBe('Matt');
  inForce(rough(0.2), light, variant('Matt', rough(0.9)));
  applyVariant(AS_CAPTURED);
  expect(draft.value).toEqual([light, variant('Matt', rough(0.9))]);
  expect(variantShown.value).toBe(AS_CAPTURED);
});

it('a renamed variant keeps its place, and a removed one takes nothing with it', () => {
  inForce(variant('One', rough(0.1)), variant('Two', rough(0.2)), rough(0.2));
  renameVariant('One', ' Three ');
  expect(draft.value).toEqual([variant('Three', rough(0.1)), variant('Two', rough(0.2)), rough(0.2)]);
  inForce(variant('One', rough(0.1)), variant('Two', rough(0.2)), rough(0.2));
  removeVariant('Two');
  expect(draft.value).toEqual([variant('One', rough(0.1)), rough(0.2)]);
});

it.each(['Two', '', ' ', 'a/b', AS_CAPTURED, 'As shown'])('the name %j is refused with a sentence', (name) => {
  inForce(variant('One', rough(0.1)), variant('Two', rough(0.2)));
  notices.value = [];
  renameVariant('One', name);
  expect(draft.value).toBe(null);
  expect(notices.value.map(({ text }) => text)).toEqual([expect.stringContaining('No variant can be called')]);
  notices.value = [];
});

it('each is worn by every vertex, the captured materials come first', () => {
  mesh.value = strip();
  const black: MaterialEdit = { op: 'material', select: { box: { minimum: [3.5, -1, -1], maximum: [9, 2, 1] } }, set: { albedo: [0, 0, 0] }, mode: 'absolute' };
  inForce(rough(0.3), variant('Matt', rough(0.9)), variant('Black', black));
  const reds = variantMaterials.value.map(({ albedo }) => Array.from({ length: 6 }, (_, i) => albedo[3 * i]));
  expect(reds).toEqual([[0, 0, 0, 0, 1, 1], [0, 0, 0, 0, 1, 1], [0, 0, 0, 0, 0, 0]]);
  expect(variantMaterials.value.map(({ roughness }) => Number(roughness[0]!.toFixed(3)))).toEqual([0.5, 0.9, 0.5]);
});

it('a variant that leaves out what another says is another one, and defaults of the server are none', () => {
  const [set, unset] = [variant('A', { ...rough(0.1), set: { roughness: 0.1, metallic: 1 } }), variant('A', rough(0.1))];
  expect(difference([set], [unset]).edits).toEqual([unset]);
  const { mode: _, ...said } = rough(0.1);
  expect(difference([unset], [variant('A', said as MaterialEdit)])).toEqual({ start: 1, remove: 0, edits: [] });
  expect(variantsOf([unset, set])).toEqual([{ name: 'A', edits: [{ ...rough(0.1), set: { roughness: 0.1, metallic: 1 } }] }]);
});
