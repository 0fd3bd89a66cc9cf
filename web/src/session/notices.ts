/** Sentences for the user that come and go at the edge of the page. */

import { signal } from '@preact/signals';

export interface Notice {
  id: number;
  kind: 'error' | 'info';
  text: string;
}
export const notices = signal<Notice[]>([]);
let noticeCount = 0;

export function notify(text: string, kind: Notice['kind'] = 'error'): void {
  if (notices.value.some((notice) => notice.text === text)) return;
  const notice = { id: ++noticeCount, kind, text };
  notices.value = [...notices.value.slice(-3), notice];
  setTimeout(() => dismiss(notice.id), kind === 'error' ? 12_000 : 5_000);
}

export function dismiss(id: number): void {
  notices.value = notices.value.filter((notice) => notice.id !== id);
}

/** Run something that may fail; a failure becomes a notice, and the answer is null. What the user gave up has no notice. */
export async function attempt<T>(work: Promise<T>): Promise<T | null> {
  try {
    return await work;
  } catch (error) {
    const givenUp = error instanceof DOMException && error.name === 'AbortError';
    if (!givenUp) notify(error instanceof Error ? error.message : String(error));
    return null;
  }
}
