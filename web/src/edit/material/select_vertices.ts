/** The vertices that a selection takes in: the twin of drgs/scene/select_vertices.py. */

import type { Selection } from '../../session/protocol.gen';
import { weightsOf } from '../../session/weights';
import type { RestMesh, VertexMaterials } from '../mesh';

/** Neighbouring vertices whose materials differ by more lie in different regions (REGION_STEP of select_vertices.py). */
const REGION_STEP = 0.1;
/** Selections of a mesh whose weights are kept. */
const REMEMBERED = 12;

const regionsOf = new WeakMap<RestMesh, Int32Array>();
const selected = new WeakMap<RestMesh, Map<string, Float32Array>>();

/** Weight 0..1 of each vertex. */
export function selectVertices(mesh: RestMesh, selection: Selection): Float32Array {
  const painted = selection.weights_file ? weightsOf(selection.weights_file) : null;
  if (selection.weights_file && !painted) return new Float32Array(mesh.materials.roughness.length); // until it is here
  let known = selected.get(mesh);
  if (!known) selected.set(mesh, (known = new Map()));
  const key = JSON.stringify(selection);
  let weights = known.get(key);
  if (!weights) {
    weights = painted ? mesh.materials.roughness.map((_, i) => painted[i] ?? 0) : computeWeights(mesh, selection);
    known.set(key, weights);
    if (known.size > REMEMBERED) known.delete(known.keys().next().value!);
  }
  return weights;
}

function computeWeights(mesh: RestMesh, selection: Selection): Float32Array {
  const count = mesh.materials.roughness.length;
  const weights = new Float32Array(count);
  const { sphere, box, similar, region, vertex_weights } = selection;
  if (selection.all) return weights.fill(1);
  if (vertex_weights) return weights.map((_, i) => vertex_weights[i] ?? 0);
  if (similar) {
    const seed = nearestVertex(mesh.positions, similar.point);
    const tolerance = similar.tolerance ?? 0.1;
    const alike = (i: number) => difference(mesh.materials, i, seed) <= tolerance;
    const parts = components(mesh, (a, b) => alike(a) && alike(b));
    return weights.map((_, i) => (parts[i] === parts[seed] ? 1 : 0));
  }
  if (region != null) {
    const regions = meshRegions(mesh);
    return weights.map((_, i) => (regions[i] === region ? 1 : 0));
  }
  const falloff = sphere?.falloff ?? box?.falloff ?? 0;
  const p = mesh.positions;
  return weights.map((_, i) => {
    let outside: number;
    if (sphere) outside = Math.hypot(...sphere.center.map((c, k) => p[3 * i + k]! - c)) - sphere.radius;
    else outside = Math.hypot(...box!.minimum.map((low, k) => Math.max(low - p[3 * i + k]!, p[3 * i + k]! - box!.maximum[k]!, 0)));
    if (falloff === 0) return outside <= 0 ? 1 : 0;
    const t = Math.min(1, Math.max(0, 1 - outside / falloff));
    return t * t * (3 - 2 * t);
  });
}

/** Region of each vertex: connected patches without a jump in material, the largest first. */
export function meshRegions(mesh: RestMesh): Int32Array {
  const known = regionsOf.get(mesh);
  if (known) return known;
  const parts = components(mesh, (a, b) => difference(mesh.materials, a, b) <= REGION_STEP);
  const sizes = new Map<number, number>(); // in the order of first vertices, which breaks ties
  for (const part of parts) sizes.set(part, (sizes.get(part) ?? 0) + 1);
  const rank = new Map([...sizes].sort((a, b) => b[1] - a[1]).map(([part], k) => [part, k]));
  const regions = parts.map((part) => rank.get(part)!);
  regionsOf.set(mesh, regions);
  return regions;
}

export function nearestVertex(positions: Float32Array, point: readonly number[]): number {
  let best = 0;
  let least = Infinity;
  for (let i = 0; i < positions.length / 3; i++) {
    const distance = (positions[3 * i]! - point[0]!) ** 2 + (positions[3 * i + 1]! - point[1]!) ** 2 + (positions[3 * i + 2]! - point[2]!) ** 2;
    if (distance < least) [best, least] = [i, distance];
  }
  return best;
}

/** Euclidean over albedo, roughness and metallic. */
function difference({ albedo, roughness, metallic }: VertexMaterials, a: number, b: number): number {
  const squares = [0, 1, 2].map((k) => (albedo[3 * a + k]! - albedo[3 * b + k]!) ** 2);
  return Math.sqrt(squares[0]! + squares[1]! + squares[2]! + (roughness[a]! - roughness[b]!) ** 2 + (metallic[a]! - metallic[b]!) ** 2);
}

/** Smallest vertex of each vertex's component, edges counting where `joined` says so. */
function components({ faces, materials }: RestMesh, joined: (a: number, b: number) => boolean): Int32Array {
  const parent = Int32Array.from(materials.roughness, (_, i) => i);
  const root = (i: number) => {
    while (parent[i] !== i) i = parent[i] = parent[parent[i]!]!;
    return i;
  };
  for (let face = 0; face < faces.length; face += 3) {
    for (let side = 0; side < 3; side++) {
      const a = faces[face + side]!;
      const b = faces[face + ((side + 1) % 3)]!;
      if (!joined(a, b)) continue;
      const [ra, rb] = [root(a), root(b)];
      if (ra !== rb) parent[Math.max(ra, rb)] = Math.min(ra, rb);
    }
  }
  return parent.map((_, i) => root(i));
}
