/** The object of a page as Python packed it: the twin of drgs/convert/page/pack_arrays.py. */

export type Numbers = Uint8Array | Uint16Array | Uint32Array;

/** Row by row. */
export interface Table {
  values: Numbers;
  rows: number;
  columns: number;
}

/** A header of plain JSON, and arrays by name. */
export interface Unpacked {
  about: Record<string, unknown>;
  arrays: Record<string, Table>;
}

interface Listed {
  name: string;
  bytes: 1 | 2 | 4;
  rows: number;
  columns: number;
}

/** Throws where the text is cut off or the browser cannot unpack zlib. */
export async function unpackText(base64: string): Promise<Unpacked> {
  const packed = Uint8Array.from(atob(base64.trim()), (letter) => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream('deflate'));
  return unpackArrays(new Uint8Array(await new Response(stream).arrayBuffer()));
}

export function unpackArrays(data: Uint8Array): Unpacked {
  const length = new DataView(data.buffer, data.byteOffset).getUint32(0, true);
  const { arrays: listed, ...about } = JSON.parse(new TextDecoder().decode(data.subarray(4, 4 + length))) as { arrays: Listed[] };
  const arrays: Record<string, Table> = {};
  let start = 4 + length;
  for (const { name, bytes, rows, columns } of listed) {
    const end = start + bytes * rows * columns;
    if (end > data.length) throw new Error('the object is cut off');
    const values = fromPlanes(data.subarray(start, end), bytes, rows, columns);
    if (bytes < 4) sumDifferences(values, columns);
    arrays[name] = { values, rows, columns };
    start = end;
  }
  return { about, arrays };
}

/** Bytes lie column after column, first the low ones of all numbers. */
function fromPlanes(planes: Uint8Array, bytes: 1 | 2 | 4, rows: number, columns: number): Numbers {
  const count = rows * columns;
  const values = bytes === 1 ? new Uint8Array(count) : bytes === 2 ? new Uint16Array(count) : new Uint32Array(count);
  for (let plane = 0; plane < bytes; plane++)
    for (let column = 0, from = plane * count; column < columns; column++)
      for (let row = 0; row < rows; row++, from++) values[row * columns + column]! |= planes[from]! << (8 * plane);
  return values;
}

/** 0, 1, 2, 3, 4 … stand for steps of 0, -1, 1, -2, 2 …; the array's own width lets them wrap. */
function sumDifferences(values: Numbers, columns: number): void {
  for (let i = 0; i < values.length; i++) {
    const code = values[i]!;
    const step = code & 1 ? -((code + 1) >> 1) : code >> 1;
    values[i] = (i < columns ? 0 : values[i - columns]!) + step;
  }
}

/** Vertex of each corner, of how far it lies behind the first vertex that no corner before used. */
export function cornersFromSteps(steps: Numbers): Uint32Array<ArrayBuffer> {
  const corners = new Uint32Array(steps.length);
  let newest = 0;
  for (let i = 0; i < steps.length; i++) {
    corners[i] = newest - steps[i]!;
    if (steps[i] === 0) newest++;
  }
  return corners;
}
