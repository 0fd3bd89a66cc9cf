/** The selection's material: what it is under the edits in force, and the edits that set, multiply and take back its values. */

import { computed, signal } from '@preact/signals';
import { sameSelection, valuesSet } from '../../session/edit_list';
import { draftEdit, edits, reviseEdits } from '../../session/edit_log';
import type { Edit, MaterialEdit, MaterialValues, Selection } from '../../session/protocol.gen';
import { sendThrottled } from '../gestures';
import { mesh } from '../mesh';
import { applyMaterials, meanMaterial, type MaterialMean } from './apply_materials';
import { flash, selection, selectionWeights } from './selection';

type Value = keyof MaterialValues;
const UNKNOWN: MaterialMean = { albedo: [0.5, 0.5, 0.5], roughness: 0.5, metallic: 0 };

/** How material edits that are made now combine with the captured values. */
export const mode = signal<'absolute' | 'multiply'>('absolute');
/** Of the mesh's vertices, with all edits; null while there is no mesh. */
export const materials = computed(() => mesh.value && applyMaterials(mesh.value, edits.value));
/** Mean over the selection, with all edits. */
export const mean = computed<MaterialMean>(() => (materials.value && selectionWeights.value && meanMaterial(materials.value, selectionWeights.value)) || UNKNOWN);

/** Set values of the selection. Multiplying edits, and painted ones, which are long, are sent when the slider is let go (`commitDraft`). */
export function editMaterial(set: MaterialValues): void {
  const select = selection.value;
  const edit: Edit = { op: 'material', select, set, mode: mode.value };
  const keys = Object.keys(set).join('+');
  if (mode.value === 'absolute' && !select.vertex_weights) return sendThrottled(`material.${keys}.${flash.value}`, edit);
  const wanted = Object.keys(set).sort().join();
  draftEdit(edit, (other) => other.op === 'material' && other.mode === edit.mode && sameSelection(select, other.select) && keysSet(other.set) === wanted);
}

const keysSet = (set: MaterialValues) => (Object.keys(set) as Value[]).filter((key) => set[key] != null).sort().join();

/** Take back what edits did to a value of the selection. */
export function resetMaterial(key: Value): void {
  const select = selection.value;
  reviseEdits((now) => withoutValue(now, select, key));
}

const touches = (edit: Edit, select: Selection, key: Value): edit is MaterialEdit => edit.op === 'material' && edit.set[key] != null && sameSelection(edit.select, select);

/** Whether an edit of this very selection sets the value. */
export const isSet = (edits: Edit[], select: Selection, key: Value) => edits.some((edit) => touches(edit, select, key));

/** The edits as if this value of this selection had never been touched. */
export function withoutValue(edits: Edit[], select: Selection, key: Value): Edit[] {
  return edits.flatMap((edit): Edit[] => {
    if (!touches(edit, select, key)) return [edit];
    const { [key]: _, ...set } = valuesSet(edit.set);
    return Object.values(set).some((value) => value !== undefined) ? [{ ...edit, set }] : [];
  });
}

/** The factor of the newest edit that multiplies this value of this selection; null where none does. */
export function factorOf<Key extends Value>(edits: Edit[], select: Selection, key: Key): MaterialValues[Key] | null {
  const newest = edits.findLast((edit) => touches(edit, select, key) && edit.mode === 'multiply') as MaterialEdit | undefined;
  return newest?.set[key] ?? null;
}
