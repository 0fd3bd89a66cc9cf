/** What a page holds, as the graphics card takes it: drgs/convert/page/encode_page.py wrote it. */

import type { Vec3 } from '../session/view';
import type { LatLong } from './light';
import { cornersFromSteps, type Table, type Unpacked } from './unpack_arrays';

export interface PageLight {
  name: string;
  /** Filtered for the roughness levels, sharpest first. */
  tables: LatLong[];
  /** Nine coefficients of red, green and blue. */
  harmonics: Vec3[];
}

export interface PageMesh {
  /** A corner of its box, z up [world units]. */
  low: Vec3;
  placeStep: number;
  normalSteps: number;
  transferLow: number;
  transferStep: number;
  /** Every edge has two faces: nobody sees its inside. */
  closed: boolean;
  corners: Uint32Array<ArrayBuffer>;
  /** VERTEX_BYTES each, in the material that was put on last. */
  vertices: ArrayBuffer;
  /** Roots of albedo, and roughness beside metallic, in every material. */
  materials: Table[][];
}

export interface PageObject {
  title: string;
  photographs: number;
  faces: { kept: number; all: number };
  /** Names: the object as it is, then its variants. */
  materials: string[];
  /** Box of the object, z up [world units]. */
  low: Vec3;
  high: Vec3;
  /** Finest first; one or two. */
  meshes: PageMesh[];
  roughnessLevels: number[];
  lights: PageLight[];
  /** Two factors of the BRDF a texel, `factorsSide` texels a side: n·v across, roughness down. */
  factors: Uint8Array;
  factorsSide: number;
}

/** A vertex: place (3), normal (2) and transfer (9) in 16 bits each; roots of albedo (3), roughness and metallic in 8; three bytes of room. */
export const VERTEX_BYTES = 36;
/** Of them, those before the material. */
const SHAPE_BYTES = 28;

interface Header {
  title: string;
  photographs: number;
  faces: { kept: number; all: number };
  materials: string[];
  meshes: { low: Vec3; high: Vec3; place_step: number; normal_steps: number; transfer_low: number; transfer_step: number; closed: boolean }[];
  roughness_levels: number[];
  lights: { name: string; harmonics: Vec3[] }[];
  factors_side: number;
}

export function readObject({ about, arrays }: Unpacked): PageObject {
  const header = about as unknown as Header;
  const named = (name: string) => {
    const found = arrays[name];
    if (!found) throw new Error(`the object lacks ${name}`);
    return found;
  };
  const tables = (light: number): LatLong[] =>
    header.roughness_levels.map((_, level) => {
      const { values, rows: texels } = named(`light${light}.${level}`);
      return { rows: Math.round(Math.sqrt(texels / 2)), radiance: fromRgbe(values as Uint8Array) };
    });
  const meshes = header.meshes.map(({ low, place_step, normal_steps, transfer_low, transfer_step, closed }, k): PageMesh => {
    const of = (name: string) => named(`mesh${k}.${name}`);
    const materials = header.materials.map((_, number) => [of(`albedo_roots${number}`), of(`surface${number}`)]);
    const vertices = new ArrayBuffer(VERTEX_BYTES * of('places').rows);
    putColumns(['places', 'normals', 'transfer'].map(of), new Uint16Array(vertices), 0);
    putColumns(materials[0]!, new Uint8Array(vertices), SHAPE_BYTES);
    return {
      low,
      placeStep: place_step,
      normalSteps: normal_steps,
      transferLow: transfer_low,
      transferStep: transfer_step,
      closed,
      corners: cornersFromSteps(of('steps').values),
      vertices,
      materials,
    };
  });
  return {
    title: header.title,
    photographs: header.photographs,
    faces: header.faces,
    materials: header.materials,
    low: header.meshes[0]!.low,
    high: header.meshes[0]!.high,
    meshes,
    roughnessLevels: header.roughness_levels,
    lights: header.lights.map(({ name, harmonics }, k) => ({ name, harmonics, tables: tables(k) })),
    factors: named('factors').values as Uint8Array,
    factorsSide: header.factors_side,
  };
}

/** Put another of its materials on a mesh. */
export function wear(mesh: PageMesh, material: number): void {
  putColumns(mesh.materials[material]!, new Uint8Array(mesh.vertices), SHAPE_BYTES);
}

/** Tables side by side into what belongs to each vertex, from a byte of it on. */
function putColumns(tables: Table[], into: Uint8Array | Uint16Array, firstByte: number): void {
  const stride = VERTEX_BYTES / into.BYTES_PER_ELEMENT;
  let at = firstByte / into.BYTES_PER_ELEMENT;
  for (const { values, rows, columns } of tables) {
    for (let row = 0; row < rows; row++) for (let k = 0; k < columns; k++) into[row * stride + at + k] = values[row * columns + k]!;
    at += columns;
  }
}

/** Red, green, blue of each texel; half a step is added, since Python rounds down. */
function fromRgbe(texels: Uint8Array): Float32Array {
  const radiance = new Float32Array((texels.length / 4) * 3);
  for (let i = 0, to = 0; i < texels.length; i += 4) {
    const unit = 2 ** (texels[i + 3]! - 128 - 8);
    for (let k = 0; k < 3; k++) radiance[to++] = (texels[i + k]! + 0.5) * unit;
  }
  return radiance;
}
