/** VertexMaterials with a name: presets, those that the user kept, and the one on the clipboard. */

import { computed, signal } from '@preact/signals';
import { commitDraft } from '../../session/edit_log';
import { notify } from '../../session/notices';
import { preference } from '../../session/preferences';
import type { MaterialMean } from './apply_materials';
import { PRESETS, type NamedMaterial } from './preset_table';
import { editMaterial, mean, mode } from './values';

export const savedMaterials = preference<NamedMaterial[]>('materials', []);
/** In the order that the panel shows. */
export const namedMaterials = computed(() => [...PRESETS, ...savedMaterials.value]);
/** Pictures of `namedMaterials` under the present light, as data addresses; drawn by the viewport. */
export const materialThumbnails = signal<string[]>([]);
export const copiedMaterial = signal<MaterialMean | null>(null);

/** Give the selection a material. */
export function assignMaterial({ albedo, roughness, metallic }: MaterialMean): void {
  mode.value = 'absolute';
  editMaterial({ albedo, roughness, metallic });
  commitDraft();
}

export function copyMaterial(): void {
  copiedMaterial.value = mean.value;
  notify('Material copied. Select another part or object and paste.', 'info');
}

export function pasteMaterial(): void {
  if (copiedMaterial.value) assignMaterial(copiedMaterial.value);
}

/** Keep the selection's material in this browser. */
export function saveMaterial(): void {
  const taken = new Set(savedMaterials.value.map(({ name }) => name));
  let number = 1;
  while (taken.has(`Mine ${number}`)) number++;
  savedMaterials.value = [...savedMaterials.value, { name: `Mine ${number}`, ...mean.value }];
}

export const forgetMaterial = (name: string) => void (savedMaterials.value = savedMaterials.value.filter((saved) => saved.name !== name));
