/** What the reader of the page has chosen: light, material, and how the picture is shown. */

import { computed, signal } from '@preact/signals';
import type { Rgb } from '../edit/material/color';
import { PRESETS } from '../edit/material/preset_table';
import type { MaterialChoice } from './picture';

/** Number of the light. */
export const chosenLight = signal(0);
/** Of the light, counter-clockwise seen from above [degrees]. */
export const rotation = signal(0);
export const exposureStops = signal(0);
/** The light's own picture stands behind the object. */
export const sky = signal(true);
/** The object goes round by itself. */
export const turning = signal(false);
export const panelOpen = signal(true);

export const WHITE: Rgb = [1, 1, 1];
/** Number of the object's own material, 0 without a variant; what follows is laid over it. */
export const worn = signal(0);
/** Of a preset; null: as the object's own material says. */
export const preset = signal<string | null>(null);
/** Set by hand; null: as the material or the preset says. */
export const roughness = signal<number | null>(null);
export const metallic = signal<number | null>(null);
export const tint = signal<Rgb>(WHITE);

export const material = computed<MaterialChoice>(() => {
  const named = PRESETS.find(({ name }) => name === preset.value);
  return { albedo: named?.albedo ?? null, roughness: roughness.value ?? named?.roughness ?? null, metallic: metallic.value ?? named?.metallic ?? null, tint: tint.value };
});

export function chooseWorn(number: number): void {
  worn.value = number;
  choosePreset(null);
}

export function choosePreset(name: string | null): void {
  preset.value = name;
  roughness.value = metallic.value = null;
  tint.value = WHITE;
}
