import { expect, it } from 'vitest';
import { holdsAsset } from '../../src/capture/zip';

/** A zip of empty files, with a comment at its end. */
function zip(...names: string[]): Blob {
  const bytes = (text: string) => new TextEncoder().encode(text);
  const parts: Uint8Array[] = [bytes('what stands before the directory')];
  const start = parts[0]!.length;
  for (const name of names) {
    const entry = new DataView(new ArrayBuffer(46));
    entry.setUint32(0, 0x02014b50, true);
    entry.setUint16(28, bytes(name).length, true);
    entry.setUint16(30, 3, true); // an extra field, to be stepped over
    parts.push(new Uint8Array(entry.buffer), bytes(name), bytes('xyz'));
  }
  const end = new DataView(new ArrayBuffer(22));
  end.setUint32(0, 0x06054b50, true);
  end.setUint32(12, parts.slice(1).reduce((sum, part) => sum + part.length, 0), true);
  end.setUint32(16, start, true);
  return new Blob([...parts, new Uint8Array(end.buffer), bytes('a comment')] as BlobPart[]);
}

it('a zip with the manifest on top, or in its one folder, is an asset', async () => {
  expect(await holdsAsset(zip('mesh.glb', 'asset.json'))).toBe(true);
  expect(await holdsAsset(zip('cup/mesh.glb', 'cup/asset.json'))).toBe(true);
});

it('a capture is none, whatever its pictures are called', async () => {
  expect(await holdsAsset(zip('transforms.json', 'images/of/asset.json', 'my-asset.json'))).toBe(false);
});

it('what is no zip is none', async () => {
  expect(await holdsAsset(new Blob(['asset.json']))).toBe(false);
  expect(await holdsAsset(new Blob([]))).toBe(false);
});
