/** Linear Rec.709 and sRGB, the same curve as drgs/maths/color.py; hex strings hold sRGB. */

export type Triple = [number, number, number];

export function srgbFromLinear(linear: number): number {
  return linear <= 0.0031308 ? 12.92 * linear : 1.055 * linear ** (1 / 2.4) - 0.055;
}

export function linearFromSrgb(srgb: number): number {
  return srgb <= 0.04045 ? srgb / 12.92 : ((srgb + 0.055) / 1.055) ** 2.4;
}

export function hexFromLinear(linear: Triple): string {
  const bytes = linear.map((value) => Math.round(255 * Math.min(1, Math.max(0, srgbFromLinear(value)))));
  return `#${bytes.map((byte) => byte.toString(16).padStart(2, '0')).join('')}`;
}

/** Linear colour of `#rrggbb`, `rrggbb` or `#rgb`; null where the text is none of these. */
export function linearFromHex(text: string): Triple | null {
  let digits = text.trim().replace(/^#/, '');
  if (/^[0-9a-f]{3}$/i.test(digits)) digits = [...digits].map((digit) => digit + digit).join('');
  if (!/^[0-9a-f]{6}$/i.test(digits)) return null;
  const channel = (start: number) => linearFromSrgb(parseInt(digits.slice(start, start + 2), 16) / 255);
  return [channel(0), channel(2), channel(4)];
}
