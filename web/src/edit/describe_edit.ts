/** An edit in one line, for the history list. */

import { valuesSet } from '../session/edit_list';
import type { Edit, MaterialValues, Selection } from '../session/protocol.gen';
import { PRESETS } from './material/preset_table';
import { environmentTitle } from './sun_and_sky';

const PART_NAMES = { region: 'Region', similar: 'Similar', sphere: 'Sphere', box: 'Box', vertex_weights: 'Painted', weights_file: 'Painted' } as const;

export function describeEdit(edit: Edit): string {
  switch (edit.op) {
    case 'material': {
      const { albedo, roughness, metallic } = edit.set;
      const known = PRESETS.find((preset) => edit.mode !== 'multiply' && sameValues(preset, edit.set));
      const parts = [albedo && 'colour', roughness != null && `roughness ${rounded(roughness)}`, metallic != null && `metallic ${rounded(metallic)}`].filter(Boolean);
      const what = known ? known.name.toLowerCase() : parts.join(', ') + (edit.mode === 'multiply' ? ' ×' : '');
      return `${partName(edit.select)}${what}`.replace(/^./, (first) => first.toUpperCase());
    }
    case 'environment': {
      const parts = [edit.file ? environmentTitle(edit.file) : 'Light'];
      if (edit.rotation) parts.push(`${Math.round(edit.rotation)}°`);
      if ((edit.intensity ?? 1) !== 1) parts.push(`× ${rounded(edit.intensity!)}`);
      return parts.join(', ');
    }
    case 'deform':
      if (edit.handles) return `Handles: ${edit.handles.drag?.length ?? 0} moved, ${edit.handles.pin?.length ?? 0} held`;
      return edit.map ? `Deform: ${edit.map.type}` : 'Deform: vertices';
    case 'pose':
      return `Pose: ${edit.clip} at ${rounded(edit.time)} s`;
    case 'simulate':
      return `Simulation at ${rounded(edit.time)} s`;
    case 'matter': {
      const { matter, pins } = edit.scene as { matter?: { preset?: string }; pins?: number[] };
      return `Matter: ${matter?.preset ?? 'of its own'}${pins?.length ? ', held' : ''}`;
    }
    case 'variant':
      return `Variant: ${edit.name}`;
    case 'unreadable':
      return 'Of another version';
  }
}

const rounded = (value: number) => (Math.round(value * 100) / 100).toString();

const sameValues = (a: MaterialValues, b: MaterialValues) => JSON.stringify(valuesSet(a)) === JSON.stringify(valuesSet(b));

function partName(select: Selection): string {
  const kind = (Object.keys(PART_NAMES) as (keyof typeof PART_NAMES)[]).find((name) => select[name] != null);
  return kind ? `${PART_NAMES[kind]}: ` : '';
}
