/**
 * The left side of the split window, traced: the object as captured, under the present light and from the present camera.
 *
 * It is asked for once the camera has been still for a while. Until it comes, the local picture stands there.
 */

import { computed, effect, signal } from '@preact/signals';
import * as api from '../session/api';
import { light } from '../edit/light';
import { notify } from '../session/notices';
import { session, settings } from '../session/session';
import { viewNow } from '../session/view';
import { photographInSight, split } from './photographs';

const STILL_MS = 400;
/** Few, and denoised: the server traces the present picture meanwhile. */
const SAMPLES = 16;

/** The request for the picture beside the present one; null while none is wanted. A background colour cannot be asked for. */
const wanted = computed(() => {
  const view = viewNow.value;
  const open = session.value;
  const { channel, background } = settings.value;
  if (!view || !open || split.value === null || photographInSight.value || channel !== 'final') return null;
  if (background === 'transparent' || Array.isArray(background)) return null;
  const query = api.frameQuery(view, view, { ...settings.value, spp_target: SAMPLES, denoise: true }, false);
  return { session: open.id, query, key: `${open.id} ${query} ${JSON.stringify(light.value)}` };
});
const wantedKey = computed(() => wanted.value?.key ?? null);
const arrived = signal<{ key: string; url: string } | null>(null);
/** Address of the picture; null while there is none of just this view and light. */
export const capturedStill = computed(() => (arrived.value && arrived.value.key === wantedKey.value ? arrived.value.url : null));

effect(() => {
  const key = wantedKey.value;
  if (key === null || key === arrived.peek()?.key) return;
  const timer = window.setTimeout(() => void fetchPicture(), STILL_MS);
  return () => window.clearTimeout(timer);
});

async function fetchPicture(): Promise<void> {
  const now = wanted.peek();
  if (!now) return;
  try {
    const url = URL.createObjectURL(await api.capturedPicture(now.session, now.query));
    if (arrived.peek()) URL.revokeObjectURL(arrived.peek()!.url);
    arrived.value = { key: now.key, url };
  } catch (error) {
    if (!(error instanceof api.ApiError)) throw error;
    notify(`The left side shows the instant local picture: the server could not trace it. ${error.message}`, 'info');
  }
}
