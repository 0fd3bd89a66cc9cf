/**
 * The left side of the split window, traced: the object as captured, under the present light and from the present camera.
 *
 * It is asked for once the camera has been still for a while; until then, and where the server cannot, the local picture stands there.
 */

import { computed, effect, signal } from '@preact/signals';
import * as api from './api';
import { photographInSight, split } from './photographs';
import { light, notify, session, settings } from './state';
import { viewNow } from './viewpoint';

const STILL_MS = 400;
/** Rays a pixel, denoised: the present picture should not wait for long. */
const SAMPLES = 16;

/** What a picture must be asked with to stand beside the present one; null while none is wanted. A background colour cannot be asked for. */
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
