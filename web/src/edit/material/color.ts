/** Linear Rec.709 and sRGB, the same formulas as drgs/maths/color.py; hex strings hold sRGB. */

import { LUMINANCE_BLUE, LUMINANCE_GREEN, LUMINANCE_RED, SRGB_ENCODED_END, SRGB_GAMMA, SRGB_LINEAR_END, SRGB_OFFSET, SRGB_SCALE, SRGB_SLOPE } from '../../session/constants.gen';

export type Rgb = [number, number, number];

export function srgbFromLinear(linear: number): number {
  return linear <= SRGB_LINEAR_END ? SRGB_SLOPE * linear : SRGB_SCALE * linear ** (1 / SRGB_GAMMA) - SRGB_OFFSET;
}

function linearFromSrgb(srgb: number): number {
  return srgb <= SRGB_ENCODED_END ? srgb / SRGB_SLOPE : ((srgb + SRGB_OFFSET) / SRGB_SCALE) ** SRGB_GAMMA;
}

export function luminance(red: number, green: number, blue: number): number {
  return LUMINANCE_RED * red + LUMINANCE_GREEN * green + LUMINANCE_BLUE * blue;
}

export function hexFromLinear(linear: Rgb): string {
  const bytes = linear.map((value) => Math.round(255 * Math.min(1, Math.max(0, srgbFromLinear(value)))));
  return `#${bytes.map((byte) => byte.toString(16).padStart(2, '0')).join('')}`;
}

/** Linear colour of `#rrggbb`, `rrggbb` or `#rgb`; null where the text is none of these. */
export function linearFromHex(text: string): Rgb | null {
  let digits = text.trim().replace(/^#/, '');
  if (/^[0-9a-f]{3}$/i.test(digits)) digits = [...digits].map((digit) => digit + digit).join('');
  if (!/^[0-9a-f]{6}$/i.test(digits)) return null;
  const channel = (start: number) => linearFromSrgb(parseInt(digits.slice(start, start + 2), 16) / 255);
  return [channel(0), channel(2), channel(4)];
}
