/** Lists of edits as plain data: whether two mean the same, and what turns one into the other. */

import type { Edit, MaterialValues, Selection } from './protocol.gen';
import { fileOf } from './weights';

export const sameSelection = (a: Selection, b: Selection) => a === b || JSON.stringify(plain(a)) === JSON.stringify(plain(b));
/** The server leaves out what is null and fills in defaults; key order follows the schema on both sides. */
const plain = ({ all, sphere, box, region, similar, vertex_weights, weights_file }: Selection) => ({
  all: all || undefined,
  sphere: sphere ? { ...sphere, falloff: sphere.falloff ?? 0 } : undefined,
  box: box ? { ...box, falloff: box.falloff ?? 0 } : undefined,
  region: region ?? undefined,
  similar: similar ? { ...similar, tolerance: similar.tolerance ?? 0.1 } : undefined,
  vertex_weights: fileOf(vertex_weights) ? undefined : (vertex_weights ?? undefined),
  weights_file: weights_file ?? fileOf(vertex_weights),
});

/** Whether two lists of edits mean the same. What only one side spells out agrees: the server fills in defaults. */
export const sameEdits = (a: Edit[], b: Edit[]) => a.length === b.length && a.every((edit, i) => agree(comparable(edit), comparable(b[i]!)));
function comparable(edit: Edit): object {
  if (edit.op === 'material') return { op: edit.op, select: JSON.stringify(plain(edit.select)), set: JSON.stringify(valuesSet(edit.set)), mode: edit.mode ?? 'absolute' };
  if (edit.op === 'variant') return { op: edit.op, name: edit.name, edits: JSON.stringify(edit.edits.map(comparable)) };
  // The server keeps scenes as they came: what one of two leaves out is a difference.
  return 'scene' in edit ? { ...edit, scene: JSON.stringify(edit.scene) } : edit;
}

/** The values without nulls, in the schema's order. */
export const valuesSet = ({ albedo, roughness, metallic }: MaterialValues) => ({ albedo: albedo ?? undefined, roughness: roughness ?? undefined, metallic: metallic ?? undefined });

function agree(a: unknown, b: unknown): boolean {
  if (a === undefined || b === undefined) return true;
  if (a === null || b === null || typeof a !== 'object' || typeof b !== 'object') return a === b;
  if (Array.isArray(a) !== Array.isArray(b) || (Array.isArray(a) && a.length !== (b as unknown[]).length)) return false;
  return Object.keys({ ...a, ...b }).every((key) => agree((a as Record<string, unknown>)[key], (b as Record<string, unknown>)[key]));
}

/** `edit` in the place of the newest one that `replaces` names, else at the end. */
export function withReplaced(edits: Edit[], edit: Edit, replaces: (other: Edit) => boolean): Edit[] {
  const at = edits.findLastIndex(replaces);
  return at < 0 ? [...edits, edit] : edits.with(at, edit);
}

/** The splice that makes `after` of `before`: behind the first `start` edits, `edits` take the place of `remove`. */
export function difference(before: Edit[], after: Edit[]): { start: number; remove: number; edits: Edit[] } {
  const same = (i: number, j: number) => sameEdits([before[i]!], [after[j]!]);
  let start = 0;
  while (start < before.length && start < after.length && same(start, start)) start++;
  let kept = 0; // at the end
  while (kept < before.length - start && kept < after.length - start && same(before.length - 1 - kept, after.length - 1 - kept)) kept++;
  return { start, remove: before.length - start - kept, edits: after.slice(start, after.length - kept) };
}
