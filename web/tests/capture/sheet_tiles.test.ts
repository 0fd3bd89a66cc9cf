import { expect, it } from 'vitest';
import { tileStyle } from '../../src/capture/sheet_tiles';

it('shows of the sheet what lies where the tile does', () => {
  // A sheet of 400 x 300 with a head of 60, tiles of 90 x 120 in columns of 100, 10 from the left.
  const layout = { count: 5, columns: 3, left: 10 / 400, top: 60 / 300, across: 100 / 400, down: 120 / 300, width: 90 / 400, aspect: 90 / 120 };
  const style = tileStyle(layout, '/sheet.jpg', 4); // second row, second column
  const [width, height] = style['background-size']!.split(' ').map((text) => parseFloat(text) / 100);
  const [x, y] = style['background-position']!.split(' ').map((text) => parseFloat(text) / 100);
  // On an element of 90 x 120 the sheet has its own size ...
  expect([90 * width!, 120 * height!]).toEqual([expect.closeTo(400, 1), expect.closeTo(300, 1)]);
  // ... and is moved by what the element lacks, times the share.
  expect([(90 - 400) * x!, (120 - 300) * y!]).toEqual([expect.closeTo(-110, 1), expect.closeTo(-180, 1)]);
  expect(style['background-image']).toBe('url("/sheet.jpg")');
});
