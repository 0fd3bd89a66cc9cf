/** How large a finished picture may be, in the server's own numbers and in words. */

import { MAX_SIDE, MAX_STILL_PIXELS, MAX_STILL_SAMPLES } from '../../session/protocol.gen';

export interface Size {
  width: number;
  height: number;
}

export const LEAST_SIDE = 16;

const megapixels = (pixels: number) => `${(Math.floor(pixels / 1e5) / 10).toLocaleString('en')} megapixels`;

/** What the server takes with so many samples a pixel. `most`: pixels of such a file. */
export function sizeLimit(samples: number, most = MAX_STILL_PIXELS): string {
  const pixels = Math.min(most, Math.floor(MAX_STILL_SAMPLES / samples));
  return `Up to ${MAX_SIDE} pixels a side and ${megapixels(pixels)} with ${samples} samples a pixel.`;
}

/** Why the server would refuse such a picture, and what to do; null where it would not. */
export function sizeTrouble({ width, height }: Size, samples: number, most = MAX_STILL_PIXELS): string | null {
  const pixels = width * height;
  if (Math.max(width, height) > MAX_SIDE) return `A side has at most ${MAX_SIDE} pixels: make the picture smaller.`;
  if (Math.min(width, height) < LEAST_SIDE) return `A side has at least ${LEAST_SIDE} pixels: make the picture larger.`;
  if (pixels > most) return `${megapixels(pixels)} are too many, ${megapixels(most)} is the limit: make the picture smaller.`;
  if (pixels * samples > MAX_STILL_SAMPLES) return `${samples} samples for each of ${megapixels(pixels)} are too many: take fewer samples, or at most ${megapixels(MAX_STILL_SAMPLES / samples)}.`;
  return null;
}
