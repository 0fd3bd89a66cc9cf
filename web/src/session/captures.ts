/** Captures that the server has and nothing need be built of yet: listed, and one of them looked at. */

import { signal } from '@preact/signals';
import * as api from './api';
import { attempt } from './notices';
import type { CaptureInfo, CaptureLook } from './protocol.gen';
import { retryWhileAway } from './uploads';

export const captures = signal<CaptureInfo[]>([]);
/** The one that is looked at. */
export const capture = signal<CaptureInfo | null>(null);
/** What can be seen of it; null until the server has looked. */
export const captureLook = signal<CaptureLook | null>(null);
/** Why it cannot be looked at. */
export const captureTrouble = signal<string | null>(null);

let leaving = new AbortController();

export async function refreshCaptures(): Promise<void> {
  captures.value = (await api.listCaptures()).captures;
}

/** Show a capture, and ask the server for what can be seen of it. */
export async function openCapture(info: CaptureInfo): Promise<void> {
  closeCapture();
  const { signal: left } = (leaving = new AbortController());
  capture.value = info;
  try {
    const look = await retryWhileAway(() => api.lookAtCapture(info.id), () => {}, left);
    if (!left.aborted) captureLook.value = look;
  } catch (error) {
    if (!left.aborted) captureTrouble.value = error instanceof Error ? error.message : String(error);
  }
}

export function closeCapture(): void {
  leaving.abort();
  capture.value = captureLook.value = captureTrouble.value = null;
}

export async function removeCapture(info: CaptureInfo): Promise<void> {
  if ((await attempt(api.deleteCapture(info.id).then(() => true))) && capture.value?.id === info.id) closeCapture();
  await attempt(refreshCaptures());
}
