/** A light as a small picture for its button. */

import { luminance, srgbFromLinear } from '../edit/material/color';
import { MIDDLE_GREY } from '../session/constants.gen';
import type { LatLong } from './light';

/** A data address; the median luminance becomes middle grey. */
export function skyThumbnail({ rows, radiance }: LatLong): string {
  const canvas = document.createElement('canvas');
  Object.assign(canvas, { width: 2 * rows, height: rows });
  const context = canvas.getContext('2d')!;
  const picture = context.createImageData(2 * rows, rows);
  const sorted = Float32Array.from({ length: 2 * rows * rows }, (_, i) => luminance(radiance[3 * i]!, radiance[3 * i + 1]!, radiance[3 * i + 2]!)).sort();
  const scale = MIDDLE_GREY / Math.max(1e-6, sorted[sorted.length >> 1]!);
  for (let i = 0; i < sorted.length; i++) {
    for (let k = 0; k < 3; k++) {
      const value = radiance[3 * i + k]! * scale;
      picture.data[4 * i + k] = 255 * srgbFromLinear(value / (1 + value));
    }
    picture.data[4 * i + 3] = 255;
  }
  context.putImageData(picture, 0, 0);
  return canvas.toDataURL('image/jpeg');
}
