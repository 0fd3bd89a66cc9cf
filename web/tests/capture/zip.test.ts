import { expect, it } from 'vitest';
import { unzipSync } from 'three/examples/jsm/libs/fflate.module.js';
import { captureAmong } from '../../src/capture/dropped_files';
import { holdsAsset, zipOf, type PlacedFile } from '../../src/capture/zip';

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

const placed = (path: string, text = path): PlacedFile => ({ path, file: new File([text], path.split('/').at(-1)!) });

it('what is zipped here is unzipped elsewhere, names of other scripts too', async () => {
  const files = [placed('cup/images/größe 1.jpg', 'one'.repeat(1000)), placed('cup/masks/größe 1.png'), placed('cup/empty.txt', '')];
  const found = unzipSync(new Uint8Array(await (await zipOf(files)).arrayBuffer()));
  expect(Object.keys(found).sort()).toEqual(files.map(({ path }) => path).sort());
  for (const { path, file } of files) expect(new TextDecoder().decode(found[path]!)).toBe(await file.text());
});

it('a zip of what is too much is refused with a sentence', async () => {
  const large = { path: 'film.mp4', file: { size: 5e9 } as File };
  await expect(zipOf([large])).rejects.toThrow('1 files of 5000 MB are more than can be sent at once');
});

it('loose pictures, a film and a folder are one capture, other files are themselves', () => {
  const pictures = captureAmong([placed('a.JPG'), placed('b.heic'), placed('c.CR3'), placed('sky.exr')]);
  expect(pictures.name).toBe('photographs');
  expect(pictures.capture.map(({ path }) => path)).toEqual(['a.JPG', 'b.heic', 'c.CR3']);
  expect(pictures.others.map(({ name }) => name)).toEqual(['sky.exr']);
  expect(captureAmong([placed('walk.mov')]).name).toBe('walk');
  const folder = captureAmong([placed('cup/transforms.json'), placed('cup/images/a.png')]);
  expect([folder.name, folder.capture.length, folder.others.length]).toEqual(['cup', 2, 0]);
  expect(captureAmong([placed('mesh.glb'), placed('capture.zip')]).capture).toEqual([]);
});
