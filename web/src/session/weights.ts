/**
 * Painted weights as files on the server: a message of the stream holds 1 MiB, and a long log would hold them again and again.
 *
 * What is painted goes up before the first edit that uses it, and edits then refer to the file. Files are called by their content, so that the
 * same weights are the same file.
 */

import { signal } from '@preact/signals';
import { getWeights, uploadWeights } from './api';
import type { Edit } from './protocol.gen';

/** Of fewer vertices they stay in the edit. */
const FEW = 20_000;

const files = new WeakMap<readonly number[], string>();
const known = signal<ReadonlyMap<string, ArrayLike<number>>>(new Map());
const asked = new Set<string>();

/** The file that these very weights went into; undefined while there is none. */
export const fileOf = (weights: readonly number[] | null | undefined) => (weights ? files.get(weights) : undefined);

/** The weights of a file; null until they are here, and whoever reads them in a computed value is told then. */
export function weightsOf(file: string): ArrayLike<number> | null {
  const found = known.value.get(file);
  if (!found && !asked.has(file)) {
    asked.add(file);
    getWeights(file).then(
      (weights) => remember(file, weights),
      () => asked.delete(file),
    );
  }
  return found ?? null;
}

const remember = (file: string, weights: ArrayLike<number>) => void (known.value = new Map(known.value).set(file, weights));

/** Painted weights of the edit that are too many for it; null where there are none. */
const longWeights = (edit: Edit) => (edit.op === 'material' && edit.select.vertex_weights && edit.select.vertex_weights.length > FEW ? edit.select.vertex_weights : null);

export const holdsLongWeights = (edits: Edit[]) => edits.some(longWeights);

/** The same edits with files in the place of long weights, which are on the server then. */
export const withWeightFiles = (edits: Edit[]): Promise<Edit[]> =>
  Promise.all(
    edits.map(async (edit) => {
      const weights = longWeights(edit);
      if (!weights || edit.op !== 'material') return edit;
      const file = files.get(weights) ?? (await uploadWeights(weights)).file;
      files.set(weights, file);
      remember(file, weights);
      return { ...edit, select: { weights_file: file } };
    }),
  );
