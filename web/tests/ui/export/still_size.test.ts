import { expect, it } from 'vitest';
import { MAX_LAYERED_PIXELS, MAX_SIDE, MAX_STILL_PIXELS, MAX_STILL_SAMPLES } from '../../../src/session/protocol.gen';
import { sizeLimit, sizeTrouble } from '../../../src/ui/export/still_size';

it('sizes that the server takes are taken, and others are refused with what to do', () => {
  expect(sizeTrouble({ width: 3840, height: 2160 }, 128)).toBe(null);
  expect(sizeTrouble({ width: 3840, height: 2160 }, 512)).toMatch(/512 samples .* 8\.2 megapixels .* fewer samples, or at most 2 megapixels/);
  expect(sizeTrouble({ width: MAX_SIDE, height: MAX_SIDE }, 4)).toMatch(/8\.8 megapixels is the limit/);
  expect(sizeTrouble({ width: MAX_SIDE + 1, height: 64 }, 4)).toMatch(/at most 4096/);
  expect(sizeTrouble({ width: 64, height: 15 }, 4)).toMatch(/at least 16/);
});

it('trouble begins exactly where the server refuses', () => {
  const width = 2048;
  const height = MAX_STILL_SAMPLES / 512 / width;
  expect(sizeTrouble({ width, height }, 512)).toBe(null);
  expect(sizeTrouble({ width, height: height + 1 }, 512)).not.toBe(null);
  expect(sizeTrouble({ width: MAX_SIDE, height: MAX_STILL_PIXELS / MAX_SIDE }, 1)).toBe(null);
  expect(sizeTrouble({ width: MAX_SIDE, height: MAX_STILL_PIXELS / MAX_SIDE + 1 }, 1)).not.toBe(null);
});

it('the limit is said in megapixels', () => {
  expect(sizeLimit(32)).toBe('Up to 4096 pixels a side and 8.8 megapixels with 32 samples a pixel.');
  expect(sizeLimit(512)).toContain('2 megapixels with 512');
  expect(sizeLimit(32, MAX_LAYERED_PIXELS)).toContain('2.2 megapixels');
  expect(sizeTrouble({ width: 1920, height: 1080 }, 32, MAX_LAYERED_PIXELS)).toBe(null);
  expect(sizeTrouble({ width: 3840, height: 2160 }, 32, MAX_LAYERED_PIXELS)).toMatch(/2\.2 megapixels is the limit/);
});
