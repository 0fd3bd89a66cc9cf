/** Strokes over a capture's pictures that say what is the object and what is not. The server finds masks of all pictures by them. */

import type { SheetLayout, Stroke } from '../session/protocol.gen';

/** As drgs/scene/strokes.py allows. */
const MOST_STROKES = 200;
const MOST_POINTS = 1000;
/** Of the picture's longer side: nearer to the last point no other one is kept. */
const NEAREST = 0.003;
const DIGITS = 4;

export type Place = [number, number];

const rounded = (value: number) => Number(Math.min(1, Math.max(0, value)).toFixed(DIGITS));

/** The stroke led on to a place, as shares of the picture's width and height. */
export function ledTo(stroke: Stroke, [x, y]: Place): Stroke {
  const to: Place = [rounded(x), rounded(y)];
  const last = stroke.points.at(-1);
  if (stroke.points.length >= MOST_POINTS || (last && Math.hypot(to[0] - last[0], to[1] - last[1]) < NEAREST)) return stroke;
  return { ...stroke, points: [...stroke.points, to] };
}

export const withStroke = (strokes: Stroke[], stroke: Stroke) => (strokes.length < MOST_STROKES && stroke.points.length > 0 ? [...strokes, stroke] : strokes);

/** Whether masks can be found by them: both kinds are there. */
export const areEnough = (strokes: Stroke[]) => (['object', 'background'] as const).every((kind) => strokes.some((stroke) => stroke.shows === kind));

/** Number of the tile of a sheet at a place, as shares of its width and height; null between tiles. */
export function tileAt({ count, columns, left, top, across, down, width }: SheetLayout, [x, y]: Place): number | null {
  const column = Math.floor((x - left) / across);
  const row = Math.floor((y - top) / down);
  const number = row * columns + column;
  return column >= 0 && row >= 0 && column < columns && number < count && x - left - column * across <= width ? number : null;
}
