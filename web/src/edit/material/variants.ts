/**
 * What the object may be made of, by name. Each variant is an edit of the session that changes nothing by itself: undone like others, and seen by every
 * viewer. A GLB of the session holds them all (KHR_materials_variants).
 */

import { computed, signal } from '@preact/signals';
import { sameEdits } from '../../session/edit_list';
import { commitDraft, edits, reviseEdits } from '../../session/edit_log';
import { notify } from '../../session/notices';
import type { Edit, MaterialEdit, VariantEdit } from '../../session/protocol.gen';
import { newKey } from '../gestures';
import { mesh, type VertexMaterials } from '../mesh';
import { applyMaterials } from './apply_materials';

/** What the strip calls the object without material edits; no variant is called so, nor as files call what is shown. */
export const AS_CAPTURED = 'As captured';
const TAKEN = [AS_CAPTURED, 'As shown'];

export type Variant = Pick<VariantEdit, 'name' | 'edits'>;

/** In the order in which they came; of two with one name the later counts. */
export function variantsOf(now: Edit[]): Variant[] {
  const found = new Map<string, Variant>();
  for (const edit of now) if (edit.op === 'variant') found.set(edit.name, { name: edit.name, edits: edit.edits });
  return [...found.values()];
}

const isMaterial = (edit: Edit): edit is MaterialEdit => edit.op === 'material';
const keeps = (name: string) => (edit: Edit) => edit.op === 'variant' && edit.name === name;

/** As text, which stays the same while other edits change: pictures of all variants are no work for every move of a slider. */
const written = computed(() => JSON.stringify(variantsOf(edits.value)));
export const variants = computed(() => JSON.parse(written.value) as Variant[]);

/** What each is made of, without `mesh` none; the first is the object as captured. */
export const variantMaterials = computed<VertexMaterials[]>(() => {
  const now = mesh.value;
  if (!now || variants.value.length === 0) return [];
  return [now.materials, ...variants.value.map(({ edits: worn }) => applyMaterials(now, worn))];
});
/** Pictures of the object in `variantMaterials`, drawn with those of the presets. */
export const variantThumbnails = signal<string[]>([]);

/** Name of the one whose edits are in force; null where it is none of them. */
export const variantShown = computed(() => {
  const now = edits.value.filter(isMaterial);
  return now.length === 0 ? AS_CAPTURED : (variants.value.find(({ edits: worn }) => sameEdits(worn, now))?.name ?? null);
});

/** A name that is free: Variant 1, Variant 2, ... */
export function freeName(taken: Variant[]): string {
  let number = 1;
  while (taken.some(({ name }) => name === `Variant ${number}`)) number++;
  return `Variant ${number}`;
}

const change = (revise: (now: Edit[]) => Edit[]) => reviseEdits(revise, newKey());

/** Keep the material edits in force; painted ones by their files, which they have once the log holds them. */
export function addVariant(): void {
  commitDraft();
  change((now) => [...now, { op: 'variant', name: freeName(variantsOf(now)), edits: now.filter(isMaterial) }]);
}

/** Put the material edits of a variant, or of none, in the place of those in force. */
export function applyVariant(name: string): void {
  commitDraft();
  change((now) => [...now.filter((edit) => !isMaterial(edit)), ...(variantsOf(now).find((variant) => variant.name === name)?.edits ?? [])]);
}

export const removeVariant = (name: string) => change((now) => now.filter((edit) => !keeps(name)(edit)));

export function renameVariant(name: string, typed: string): void {
  const to = typed.trim();
  if (to === name) return;
  const others = variants.value.map((variant) => variant.name);
  if (!to || to.includes('/') || TAKEN.includes(to) || others.includes(to)) {
    return notify(`No variant can be called “${to}”: a name is one line without slashes that nothing else here has.`);
  }
  change((now) => now.map((edit) => (edit.op === 'variant' && edit.name === name ? { ...edit, name: to } : edit)));
}
