import { expect, it } from 'vitest';
import { hexFromLinear, linearFromHex, luminance } from '../../../src/edit/material/color';

it('hex colours survive the way to linear and back', () => {
  for (const hex of ['#000000', '#2050e0', '#ffffff', '#010203']) expect(hexFromLinear(linearFromHex(hex)!)).toBe(hex);
  expect(linearFromHex('#12345')).toBe(null);
});

it('white has luminance 1', () => {
  expect(luminance(1, 1, 1)).toBeCloseTo(1, 12);
});
