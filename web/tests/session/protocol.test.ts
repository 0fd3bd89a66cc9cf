import { expect, it } from 'vitest';
import { FRAME_HEADER_BYTES, readFrameHeader } from '../../src/session/protocol.gen';

it('reads the 24 little-endian bytes before a picture', () => {
  const bytes = new DataView(new ArrayBuffer(FRAME_HEADER_BYTES + 1));
  bytes.setUint8(0, 1);
  bytes.setUint8(1, 1);
  bytes.setUint16(2, 0x4203, true);
  bytes.setUint32(4, 77, true);
  bytes.setUint32(8, 5, true);
  [800, 600, 32, 256].forEach((value, i) => bytes.setUint16(12 + 2 * i, value, true));
  bytes.setUint32(20, 1234567, true);
  expect(readFrameHeader(bytes.buffer)).toEqual({ kind: 1, codec: 1, flags: 0x4203, frameId: 77, stateRev: 5, width: 800, height: 600, spp: 32, sppTarget: 256, renderMicroseconds: 1234567 });
});
