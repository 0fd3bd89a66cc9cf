/** The light in force, and the edits that change it. */

import { computed, signal } from '@preact/signals';
import { edits, reviseEdits } from '../session/edit_log';
import type { Edit, EnvironmentEdit } from '../session/protocol.gen';
import { sendThrottled } from './gestures';

export interface Light {
  /** Of the environment; null: the asset's own. */
  file: string | null;
  /** Degrees, counter-clockwise seen from above. */
  rotation: number;
  intensity: number;
}

/** An environment edit without a file keeps the one in force; rotation and intensity it always sets. */
export function lightOf(edits: Edit[]): Light {
  let light: Light = { file: null, rotation: 0, intensity: 1 };
  for (const edit of edits) {
    if (edit.op === 'environment') light = { file: edit.file ?? light.file, rotation: edit.rotation ?? 0, intensity: edit.intensity ?? 1 };
  }
  return light;
}

export const light = computed(() => lightOf(edits.value));
/** Picture of the asset's own environment, as a data address, drawn by the viewport; null until it is here. */
export const capturedEnvironmentThumbnail = signal<string | null>(null);

const environmentEdit = ({ file, rotation, intensity }: Light): EnvironmentEdit => ({ op: 'environment', file, rotation, intensity });

/** `key`: of a gesture that lasts until the hand lets go, however slowly it moves. */
export function editLight(change: Partial<Light>, key?: string): void {
  sendThrottled(`light.${Object.keys(change).join('+')}`, environmentEdit({ ...light.value, ...change }), key);
}

/** The asset's own environment again: the edits that named another go, for one without a file would keep it. */
export function restoreCapturedLight(): void {
  reviseEdits((now) => {
    const { rotation, intensity } = lightOf(now);
    const others = now.filter((edit) => edit.op !== 'environment');
    return rotation || intensity !== 1 ? [...others, environmentEdit({ file: null, rotation, intensity })] : others;
  });
}
