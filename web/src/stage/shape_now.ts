/**
 * Where the object's vertices are now, for the local picture: computed here of analytic maps, and asked of the server for what it alone knows, which
 * is handles, simulations and clips.
 *
 * One answer is waited for at a time. While a handle is dragged the picture shows the newest, so it follows the hand as fast as the server poses.
 */

import { computed, effect, signal } from '@preact/signals';
import { mesh } from '../edit/mesh';
import { deformPoints, isAnalytic } from '../edit/shape/deform_maps';
import { playing } from '../edit/shape/simulation';
import * as api from '../session/api';
import { sameEdits } from '../session/edit_list';
import { edits, log } from '../session/edit_log';
import type { Edit } from '../session/protocol.gen';
import { session } from '../session/session';
import { localPicture } from './switches';

/** What a shape is asked for of. */
interface Movers {
  session: string;
  /** Edits that may move something. */
  edits: Edit[];
}

const served = signal<(Movers & { positions: Float32Array }) | null>(null);

/** Null: this browser knows the shape, or nobody looks at it. A film is shown by traced pictures, which come with its moments. */
const wanted = computed<Movers | null>(() => {
  const open = session.value?.id;
  const now = log.value.edits;
  if (open === undefined || !mesh.value || !localPicture.value || playing.value || isAnalytic(now)) return null;
  return { session: open, edits: now.filter(({ op }) => op !== 'material' && op !== 'environment' && op !== 'matter' && op !== 'variant') };
});

/** Vertex positions, three numbers each; null while only the server knows them. */
export const shapeNow = computed<Float32Array | null>(() => {
  const rest = mesh.value?.positions;
  if (!rest) return null;
  if (isAnalytic(edits.value)) return deformPoints(rest, edits.value);
  const { session: of, positions } = served.value ?? {};
  return of === session.value?.id && positions?.length === rest.length ? positions : null;
});
export const shapeIsKnown = computed(() => shapeNow.value !== null);

effect(() => {
  if (wanted.value) void ask();
  else served.value = null;
});

const isServed = (next: Movers) => served.peek()?.session === next.session && sameEdits(served.peek()!.edits, next.edits);
let asking = false;

async function ask(): Promise<void> {
  if (asking) return;
  asking = true;
  try {
    for (let next = wanted.peek(); next && !isServed(next); next = wanted.peek()) {
      const positions = await api.sessionVertices(next.session);
      if (wanted.peek()?.session === next.session) served.value = { ...next, positions };
    }
  } catch {
    // Traced pictures show the shape; the next change asks again.
  } finally {
    asking = false;
  }
}
