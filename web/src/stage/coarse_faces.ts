/**
 * Fewer faces on the same vertices, for pictures in motion where drawing all of them takes too long. Vertices that share a cell of a grid are one there,
 * so that shape and materials may change as they do for all.
 *
 * Source: vertex clustering, Rossignac and Borrel, "Multi-resolution 3D approximations for rendering complex scenes", 1993.
 */

/** Faces that also a browser without a GPU draws fluently. */
export const MOST_MOVING_FACES = 30_000;
/** Of a grid's cells along the longest side, from one attempt to the next. */
const FEWER_CELLS = 0.8;

/** At most `most` of `faces`, corners of which stand for the vertices of their cells; `faces` themselves where these are no more. */
export function coarseFaces(positions: Float32Array, faces: Uint32Array, most = MOST_MOVING_FACES): Uint32Array {
  const low = [Infinity, Infinity, Infinity];
  const high = [-Infinity, -Infinity, -Infinity];
  positions.forEach((value, i) => {
    low[i % 3] = Math.min(low[i % 3]!, value);
    high[i % 3] = Math.max(high[i % 3]!, value);
  });
  const extent = Math.max(...high.map((value, axis) => value - low[axis]!));
  let coarse = faces;
  // A closed surface crosses about three times the square of the cells along its side, in two faces each.
  for (let cells = Math.ceil(Math.sqrt(most / 2)); coarse.length > 3 * most && cells > 1; cells = Math.floor(FEWER_CELLS * cells)) {
    coarse = facesBetweenCells(standIns(positions, low, extent / cells), faces);
  }
  return coarse;
}

/** Of each vertex, the first one in its cell. */
function standIns(positions: Float32Array, low: number[], cell: number): Uint32Array {
  const first = new Map<number, number>();
  const along = 2 ** 17;
  return Uint32Array.from({ length: positions.length / 3 }, (_, vertex) => {
    const [x, y, z] = low.map((start, axis) => Math.floor((positions[3 * vertex + axis]! - start) / cell)) as [number, number, number];
    const key = (x * along + y) * along + z;
    const found = first.get(key);
    if (found === undefined) first.set(key, vertex);
    return found ?? vertex;
  });
}

function facesBetweenCells(standIn: Uint32Array, faces: Uint32Array): Uint32Array {
  const kept = new Uint32Array(faces.length);
  let count = 0;
  for (let i = 0; i < faces.length; i += 3) {
    const [a, b, c] = [standIn[faces[i]!]!, standIn[faces[i + 1]!]!, standIn[faces[i + 2]!]!];
    if (a === b || b === c || c === a) continue;
    kept.set([a, b, c], count);
    count += 3;
  }
  return kept.slice(0, count);
}
