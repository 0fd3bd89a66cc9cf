/** A tile of a capture's sheet as the background of an element of any width. */

import type { SheetLayout } from '../session/protocol.gen';

/** CSS: a background's position in percent is that of a place of the picture that lies over the same place of the element. */
export function tileStyle({ columns, left, top, across, down, width, aspect }: SheetLayout, sheet: string, number: number): Record<string, string> {
  const x = left + (number % columns) * across;
  const y = top + Math.floor(number / columns) * down;
  const percent = (start: number, size: number) => `${(size < 1 ? (100 * start) / (1 - size) : 0).toFixed(3)}%`;
  return {
    'aspect-ratio': String(aspect),
    'background-image': `url("${sheet}")`,
    'background-size': `${(100 / width).toFixed(3)}% ${(100 / down).toFixed(3)}%`,
    'background-position': `${percent(x, width)} ${percent(y, down)}`,
  };
}
