import { afterEach, beforeEach, expect, it, vi } from 'vitest';
import { exportedFile } from '../../src/session/api';
import { computing, LONG_MS, noteWaiting } from '../../src/session/long_change';
import { attempt, notices } from '../../src/session/notices';

beforeEach(() => {
  vi.useFakeTimers();
  notices.value = []; // files share their modules, and what another left is none of ours
});
afterEach(() => {
  noteWaiting(0);
  vi.useRealTimers();
  vi.unstubAllGlobals();
});

it('a change is long once it has waited alone for a while, and not after its answer', () => {
  noteWaiting(1);
  vi.advanceTimersByTime(LONG_MS - 1);
  expect(computing.value).toBe(false);
  vi.advanceTimersByTime(1);
  expect(computing.value).toBe(true);
  noteWaiting(0);
  expect(computing.value).toBe(false);
  vi.advanceTimersByTime(2 * LONG_MS);
  expect(computing.value).toBe(false);
});

it('many changes that are answered quickly are not long', () => {
  for (let k = 0; k < 50; k++) {
    noteWaiting(3);
    vi.advanceTimersByTime(LONG_MS / 2);
    expect(computing.value).toBe(false);
  }
});

it('a file that is given up leaves the server at once and has no notice; one that fails has', async () => {
  vi.stubGlobal('fetch', (_: string, { signal }: { signal: AbortSignal }) => new Promise((_, reject) => signal.addEventListener('abort', () => reject(signal.reason as Error))));
  const leaving = new AbortController();
  const file = attempt(exportedFile('/api/assets/a/export?format=glb', leaving.signal));
  leaving.abort();
  expect(await file).toBeNull();
  expect(notices.value).toEqual([]);
  vi.stubGlobal('fetch', () => Promise.reject(new TypeError('network')));
  expect(await attempt(exportedFile('/api/assets/a/export?format=glb', new AbortController().signal))).toBeNull();
  expect(notices.value).toHaveLength(1);
});
