import { expect, test } from 'vitest';
import { cornersFromSteps, unpackArrays } from '../../src/page/unpack_arrays';

function packed(header: object, ...bytes: number[]): Uint8Array {
  const text = new TextEncoder().encode(JSON.stringify(header));
  const data = new Uint8Array(4 + text.length + bytes.length);
  new DataView(data.buffer).setUint32(0, text.length, true);
  data.set(text, 4);
  data.set(bytes, 4 + text.length);
  return data;
}

test('differences, columns and byte planes are turned back into rows', () => {
  // Rows (300, 5), (298, 65535), (300, 1): steps 300, -2, 2 and 5, -6, 2, written as 600, 3, 4 and 10, 11, 4.
  const wide = { name: 'wide', bytes: 2, rows: 3, columns: 2 };
  const plain = { name: 'plain', bytes: 4, rows: 2, columns: 1 };
  const data = packed({ title: 'a', arrays: [wide, plain] }, 600 & 255, 3, 4, 10, 11, 4, 600 >> 8, 0, 0, 0, 0, 0, 1, 2, 3, 0, 0, 0, 0, 0);
  const { about, arrays } = unpackArrays(data);
  expect(about).toEqual({ title: 'a' });
  expect([...arrays.wide!.values]).toEqual([300, 5, 298, 65535, 300, 1]);
  expect([...arrays.plain!.values]).toEqual([1 + (3 << 8), 2]);
  expect(() => unpackArrays(data.subarray(0, data.length - 1))).toThrow('cut off');
});

test('corners count back from the newest vertex', () => {
  expect([...cornersFromSteps(new Uint32Array([0, 0, 0, 1, 2, 0]))]).toEqual([0, 1, 2, 2, 1, 3]);
});
