/** Whether the server has been computing one change for so long that the user may want to give it up. */

import { signal } from '@preact/signals';

/** Most changes are answered sooner. */
export const LONG_MS = 800;

export const computing = signal(false);
let timer: ReturnType<typeof setTimeout> | undefined;

/** So many changes are not answered. Said anew after each answer, so that a drag of many quick ones is not long. */
export function noteWaiting(count: number): void {
  clearTimeout(timer);
  computing.value = false;
  if (count > 0) timer = setTimeout(() => (computing.value = true), LONG_MS);
}
