import { expect, it } from 'vitest';
import { areEnough, ledTo, tileAt, withStroke } from '../../src/capture/strokes';
import type { Stroke } from '../../src/session/protocol.gen';

const stroke: Stroke = { picture: 'a', shows: 'object', radius: 0.01, points: [[0.5, 0.5]] };

it('leads a stroke on by places that are apart, and keeps it in the picture', () => {
  expect(ledTo(stroke, [0.5001, 0.5])).toBe(stroke);
  expect(ledTo(stroke, [1.2, -0.1]).points).toEqual([[0.5, 0.5], [1, 0]]);
  expect(ledTo({ ...stroke, points: Array(1000).fill([0, 0]) }, [1, 1]).points.length).toBe(1000);
});

it('takes no more strokes than the server does, and none without a place', () => {
  expect(withStroke([], { ...stroke, points: [] })).toEqual([]);
  expect(withStroke(Array(200).fill(stroke), stroke).length).toBe(200);
});

it('asks for both kinds before masks are looked for', () => {
  expect(areEnough([stroke])).toBe(false);
  expect(areEnough([stroke, { ...stroke, shows: 'background' }])).toBe(true);
});

it('finds the tile that was clicked', () => {
  const layout = { count: 5, columns: 3, left: 10 / 400, top: 60 / 300, across: 100 / 400, down: 120 / 300, width: 90 / 400, aspect: 90 / 120 };
  expect(tileAt(layout, [150 / 400, 200 / 300])).toBe(4);
  expect(tileAt(layout, [104 / 400, 100 / 300])).toBe(null); // between two
  expect(tileAt(layout, [250 / 400, 200 / 300])).toBe(null); // behind the last
  expect(tileAt(layout, [50 / 400, 10 / 300])).toBe(null); // the head
});
