/** What an ordered list of edits amounts to, as far as the panels and the local picture show it. */

import { presets } from './presets';
import type { Edit, EnvironmentEdit, MaterialEdit, MaterialValues, Selection } from './protocol.gen';
import { environmentTitle } from './sun_and_sky';

export interface Light {
  /** Null: the asset's own environment. */
  file: string | null;
  /** Degrees, counter-clockwise seen from above. */
  rotation: number;
  intensity: number;
}

export function lightOf(edits: Edit[]): Light {
  let light: Light = { file: null, rotation: 0, intensity: 1 };
  for (const edit of edits) {
    if (edit.op === 'environment') light = { file: edit.file ?? light.file, rotation: edit.rotation ?? 0, intensity: edit.intensity ?? 1 };
  }
  return light;
}

export function environmentEdit(light: Light): EnvironmentEdit {
  return { op: 'environment', file: light.file, rotation: light.rotation, intensity: light.intensity };
}

export const sameSelection = (a: Selection, b: Selection) => a === b || JSON.stringify(plain(a)) === JSON.stringify(plain(b));
/** The server leaves out what is null and fills in defaults; key order follows the schema on both sides. */
const plain = ({ all, sphere, box, region, similar, vertex_weights }: Selection) => ({
  all: all || undefined,
  sphere: sphere ? { ...sphere, falloff: sphere.falloff ?? 0 } : undefined,
  box: box ? { ...box, falloff: box.falloff ?? 0 } : undefined,
  region: region ?? undefined,
  similar: similar ? { ...similar, tolerance: similar.tolerance ?? 0.1 } : undefined,
  vertex_weights: vertex_weights ?? undefined,
});
/** Whether two lists of edits mean the same; of what one side leaves out (defaults that the server fills in) nothing is asked. */
export const sameEdits = (a: Edit[], b: Edit[]) => a.length === b.length && a.every((edit, i) => agree(comparable(edit), comparable(b[i]!)));
const comparable = (edit: Edit) =>
  edit.op === 'material' ? { op: edit.op, select: JSON.stringify(plain(edit.select)), set: JSON.stringify(valuesOf(edit.set)), mode: edit.mode ?? 'absolute' } : edit;
const valuesOf = ({ albedo, roughness, metallic }: MaterialValues) => ({ albedo: albedo ?? undefined, roughness: roughness ?? undefined, metallic: metallic ?? undefined });

function agree(a: unknown, b: unknown): boolean {
  if (a === undefined || b === undefined) return true;
  if (a === null || b === null || typeof a !== 'object' || typeof b !== 'object') return a === b;
  if (Array.isArray(a) !== Array.isArray(b) || (Array.isArray(a) && a.length !== (b as unknown[]).length)) return false;
  return Object.keys({ ...a, ...b }).every((key) => agree((a as Record<string, unknown>)[key], (b as Record<string, unknown>)[key]));
}

const touches = (edit: Edit, select: Selection, key: keyof MaterialValues): edit is MaterialEdit =>
  edit.op === 'material' && edit.set[key] != null && sameSelection(edit.select, select);

/** Whether an edit of this very selection sets the value. */
export const isSet = (edits: Edit[], select: Selection, key: keyof MaterialValues) => edits.some((edit) => touches(edit, select, key));

/** The edits as if this value of this selection had never been touched. */
export function withoutValue(edits: Edit[], select: Selection, key: keyof MaterialValues): Edit[] {
  return edits.flatMap((edit): Edit[] => {
    if (!touches(edit, select, key)) return [edit];
    const { [key]: _, ...set } = valuesOf(edit.set);
    return Object.values(set).some((value) => value !== undefined) ? [{ ...edit, set }] : [];
  });
}

/** The factor that multiplying edits of this selection give a value: the newest one's, 1 where there is none. */
export function factorOf<Key extends keyof MaterialValues>(edits: Edit[], select: Selection, key: Key): MaterialValues[Key] | null {
  const newest = edits.findLast((edit) => touches(edit, select, key) && edit.mode === 'multiply') as MaterialEdit | undefined;
  return newest?.set[key] ?? null;
}

/** `edit` in the place of the newest one that `replaces` names, else at the end. */
export function withReplaced(edits: Edit[], edit: Edit, replaces: (other: Edit) => boolean): Edit[] {
  const at = edits.findLastIndex(replaces);
  return at < 0 ? [...edits, edit] : edits.with(at, edit);
}

/** What has to be exchanged in `before` to make it `after`: `remove` edits behind the first `start`, for `edits`. */
export function difference(before: Edit[], after: Edit[]): { start: number; remove: number; edits: Edit[] } {
  const same = (i: number, j: number) => sameEdits([before[i]!], [after[j]!]);
  let start = 0;
  while (start < before.length && start < after.length && same(start, start)) start++;
  let kept = 0; // at the end
  while (kept < before.length - start && kept < after.length - start && same(before.length - 1 - kept, after.length - 1 - kept)) kept++;
  return { start, remove: before.length - start - kept, edits: after.slice(start, after.length - kept) };
}

const rounded = (value: number) => (Math.round(value * 100) / 100).toString();

const PART_NAMES = { region: 'Region', similar: 'Similar', sphere: 'Sphere', box: 'Box', vertex_weights: 'Painted' } as const;

function partName(select: Selection): string {
  const kind = (Object.keys(PART_NAMES) as (keyof typeof PART_NAMES)[]).find((name) => select[name] != null);
  return kind ? `${PART_NAMES[kind]}: ` : '';
}

const sameValues = (a: MaterialValues, b: MaterialValues) => JSON.stringify(valuesOf(a)) === JSON.stringify(valuesOf(b));

/** One line for the history list. */
export function describeEdit(edit: Edit): string {
  switch (edit.op) {
    case 'material': {
      const { albedo, roughness, metallic } = edit.set;
      const known = presets.find((preset) => edit.mode !== 'multiply' && sameValues(preset, edit.set));
      const parts = [albedo && 'colour', roughness != null && `roughness ${rounded(roughness)}`, metallic != null && `metallic ${rounded(metallic)}`].filter(Boolean);
      const what = known ? known.name.toLowerCase() : parts.join(', ') + (edit.mode === 'multiply' ? ' ×' : '');
      return `${partName(edit.select)}${what}`.replace(/^./, (first) => first.toUpperCase());
    }
    case 'environment': {
      const parts = [edit.file ? environmentTitle(edit.file) : 'Light'];
      if (edit.rotation) parts.push(`${Math.round(edit.rotation)}°`);
      if ((edit.intensity ?? 1) !== 1) parts.push(`× ${rounded(edit.intensity!)}`);
      return parts.join(', ');
    }
    case 'deform':
      if (edit.handles) return `Handles: ${edit.handles.drag?.length ?? 0} moved, ${edit.handles.pin?.length ?? 0} held`;
      return edit.map ? `Deform: ${edit.map.type}` : 'Deform: vertices';
    case 'pose':
      return `Pose: ${edit.clip} at ${rounded(edit.time)} s`;
    case 'simulate':
      return `Simulation at ${rounded(edit.time)} s`;
  }
}
