/** A PLY of Gaussians as a smaller file of another kind, written in the browser; what writes it is loaded when it is first asked for. */

import type { SplatFormat } from '../../../session/constants.gen';
import type { Answer, Order } from './messages';

/** `onShare`: 0..1 of the part that takes long.
 *
 * Fails with a sentence; with an AbortError where `leaving` says so, which ends the work at once. */
export function transformSplats(ply: ArrayBuffer, format: SplatFormat, onShare: (share: number) => void, leaving: AbortSignal): Promise<Blob> {
  const worker = new Worker(new URL('./worker.ts', import.meta.url), { type: 'module' });
  return new Promise<Blob>((resolve, reject) => {
    const fail = (what: string) => reject(new Error(`The browser could not write this file (${what.replace(/\.$/, '')}); \`drgs export\` writes it where Node is installed.`));
    leaving.addEventListener('abort', () => reject(leaving.reason as Error));
    leaving.throwIfAborted();
    worker.onerror = (event) => {
      event.preventDefault(); // the sentence is said once
      fail(event.message || 'its program did not load');
    };
    worker.onmessage = ({ data }: MessageEvent<Answer>) => {
      if ('share' in data) onShare(data.share);
      else if ('file' in data) resolve(new Blob([data.file], { type: 'application/octet-stream' }));
      else fail(data.trouble);
    };
    worker.postMessage({ ply, format } satisfies Order, [ply]);
  }).finally(() => worker.terminate());
}
