import { expect, it } from 'vitest';
import { FRAME_HEADER_BYTES, readFrameHeader } from '../src/protocol.gen';
import { asCurl, asPython } from '../src/scripts';
import { hexFromLinear, linearFromHex } from '../src/color';

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

it('hex colours survive the way to linear and back', () => {
  for (const hex of ['#000000', '#2050e0', '#ffffff', '#010203']) expect(hexFromLinear(linearFromHex(hex)!)).toBe(hex);
  expect(linearFromHex('#12345')).toBe(null);
});

it('scripts hold edits in their own language', () => {
  const scene = { origin: 'http://127.0.0.1:8000', asset: 'a1', session: 's1', edits: [{ op: 'material' as const, select: { all: true, region: null }, set: { metallic: 1 } }], view: null, settings: { spp_target: 64 } };
  expect(asPython(scene)).toContain('session.edit({"op": "material", "select": {"all": True}, "set": {"metallic": 1}})');
  expect(asCurl(scene)).toContain("'http://127.0.0.1:8000/api/sessions/s1/frame.png'");
});
