/** Large files in parts: an upload goes on from what has arrived whenever the connection was lost or the server restarted, for as long as the page is there. */

import * as api from './api';

/** Of a part. What a lost connection costs at most where a proxy on the way keeps requests until they are whole. */
const PART_BYTES = 8 << 20;
const FIRST_PAUSE_MS = 500;
const LONGEST_PAUSE_MS = 10_000;
/** No answer, and answers after which the same call may succeed. */
const PASSING = new Set([0, 408, 429, 502, 503, 504]);
const CONFLICT = 409;

export interface UploadProgress {
  /** That has arrived, 0..1. */
  share: number;
  /** The connection is lost, or the server is too busy: it is tried again. */
  waiting: boolean;
}

/** Do it again, with growing pauses, while the server is away. `onWait`: before each pause. */
export async function retryWhileAway<T>(work: () => Promise<T>, onWait: () => void, leaving: AbortSignal): Promise<T> {
  for (let pause = FIRST_PAUSE_MS; ; pause = Math.min(2 * pause, LONGEST_PAUSE_MS)) {
    leaving.throwIfAborted();
    try {
      return await work();
    } catch (error) {
      if (!(error instanceof api.ApiError) || !PASSING.has(error.status)) throw error;
    }
    onWait();
    await rest(pause, leaving);
  }
}

/** Send all of it; the id of the complete upload. Throws an ApiError where the server refuses it, and an AbortError when `leaving` says so. */
export async function sendInParts(file: Blob, name: string, onProgress: (progress: UploadProgress) => void, leaving: AbortSignal): Promise<string> {
  let offset = 0;
  const tell = (arrived: number, waiting = false) => onProgress({ share: Math.min(1, arrived / file.size), waiting });
  const wait = () => tell(offset, true);
  const address = await retryWhileAway(() => api.announceUpload(name, file.size), wait, leaving);
  leaving.addEventListener('abort', () => void api.deleteUpload(address).catch(() => {})); // else it is forgotten after a day
  let lost = false;
  const step = async () => {
    if (lost) tell((offset = await api.uploadOffset(address)));
    lost = true;
    offset = await api.sendPart(address, offset, file.slice(offset, offset + PART_BYTES), (sent) => tell(offset + sent), leaving).catch((error: unknown) => {
      if (error instanceof api.ApiError && error.status === CONFLICT) return api.uploadOffset(address);
      throw error;
    });
    lost = false;
    tell(offset);
  };
  while (offset < file.size) await retryWhileAway(step, wait, leaving);
  return address.slice(address.lastIndexOf('/') + 1);
}

function rest(milliseconds: number, leaving: AbortSignal): Promise<void> {
  return new Promise((resolve) => {
    const wake = () => {
      clearTimeout(timer);
      window.removeEventListener('online', wake);
      leaving.removeEventListener('abort', wake);
      resolve();
    };
    const timer = setTimeout(wake, milliseconds);
    window.addEventListener('online', wake);
    leaving.addEventListener('abort', wake);
  });
}
