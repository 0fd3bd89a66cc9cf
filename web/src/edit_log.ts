/** What an ordered list of edits amounts to, as far as the panels and the local picture show it. */

import type { Triple } from './color';
import type { Edit, EnvironmentEdit } from './protocol.gen';

/** The captured value is replaced by `value` (null: kept), then multiplied by `factor`. */
export interface MaterialOverride {
  albedo: { value: Triple | null; factor: Triple };
  roughness: { value: number | null; factor: number };
  metallic: { value: number | null; factor: number };
}

export interface Light {
  /** Null: the asset's own environment. */
  file: string | null;
  /** Degrees, counter-clockwise seen from above. */
  rotation: number;
  intensity: number;
}

/** Edits of parts of the object are left out: only the server shows those. */
export function wholeObjectMaterial(edits: Edit[]): MaterialOverride {
  const result: MaterialOverride = { albedo: { value: null, factor: [1, 1, 1] }, roughness: { value: null, factor: 1 }, metallic: { value: null, factor: 1 } };
  for (const edit of edits) {
    if (edit.op !== 'material' || !edit.select.all) continue;
    const { albedo, roughness, metallic } = edit.set;
    if (edit.mode === 'multiply') {
      if (albedo) result.albedo.factor = result.albedo.factor.map((factor, i) => factor * albedo[i]!) as Triple;
      if (roughness != null) result.roughness.factor *= roughness;
      if (metallic != null) result.metallic.factor *= metallic;
    } else {
      if (albedo) result.albedo = { value: albedo, factor: [1, 1, 1] };
      if (roughness != null) result.roughness = { value: roughness, factor: 1 };
      if (metallic != null) result.metallic = { value: metallic, factor: 1 };
    }
  }
  return result;
}

export function lightOf(edits: Edit[]): Light {
  let light: Light = { file: null, rotation: 0, intensity: 1 };
  for (const edit of edits) {
    if (edit.op === 'environment') light = { file: edit.file ?? light.file, rotation: edit.rotation ?? 0, intensity: edit.intensity ?? 1 };
  }
  return light;
}

export function environmentEdit(light: Light): EnvironmentEdit {
  return { op: 'environment', file: light.file, rotation: light.rotation, intensity: light.intensity };
}

const rounded = (value: number) => (Math.round(value * 100) / 100).toString();

/** One line for the history list. */
export function describeEdit(edit: Edit): string {
  switch (edit.op) {
    case 'material': {
      const { albedo, roughness, metallic } = edit.set;
      const parts = [albedo && 'base colour', roughness != null && `roughness ${rounded(roughness)}`, metallic != null && `metallic ${rounded(metallic)}`].filter(Boolean);
      const times = edit.mode === 'multiply' ? ' ×' : '';
      return `${edit.select.all ? '' : 'Part: '}${parts.join(', ')}${times}`.replace(/^./, (first) => first.toUpperCase());
    }
    case 'environment': {
      const parts = [edit.file ? edit.file.replace(/\.(exr|hdr)$/i, '') : 'Light'];
      if (edit.rotation) parts.push(`${Math.round(edit.rotation)}°`);
      if ((edit.intensity ?? 1) !== 1) parts.push(`× ${rounded(edit.intensity!)}`);
      return parts.join(', ');
    }
    case 'deform':
      return edit.map ? `Deform: ${edit.map.type}` : 'Deform: vertices';
    case 'pose':
      return `Pose: ${edit.clip} at ${rounded(edit.time)} s`;
    case 'simulate':
      return `Simulation at ${rounded(edit.time)} s`;
  }
}
