/** What is on screen as a program: the same edits, camera and settings. */

import { frameQuery } from '../../session/api';
import type { Edit, Settings } from '../../session/protocol.gen';
import type { View } from '../../session/view';

export interface Scene {
  origin: string;
  asset: string;
  session: string;
  edits: Edit[];
  view: View | null;
  settings: Settings;
}

export const asEdits = (edits: Edit[]) => JSON.stringify(edits.map(withoutNulls), null, 1);

/** As Python literals: JSON's null, true and false are spelt otherwise there. */
function python(value: unknown): string {
  if (value === null || value === undefined) return 'None';
  if (typeof value === 'boolean') return value ? 'True' : 'False';
  if (Array.isArray(value)) return `[${value.map(python).join(', ')}]`;
  if (typeof value === 'object') return `{${Object.entries(value).map(([key, entry]) => `${JSON.stringify(key)}: ${python(entry)}`).join(', ')}}`;
  return JSON.stringify(value);
}

const withoutNulls = <T>(value: T): T =>
  (Array.isArray(value) ? value.map(withoutNulls) : value && typeof value === 'object' ? Object.fromEntries(Object.entries(value).filter(([, entry]) => entry !== null).map(([key, entry]) => [key, withoutNulls(entry)])) : value) as T;

export function asPython({ origin, asset, edits, view, settings }: Scene): string {
  const frame = view && [`width=${view.width}`, `height=${view.height}`, `spp=${settings.spp_target}`, `fov_y_degrees=${view.fov_y_degrees}`, `exposure_stops=${settings.exposure_stops}`, `tone_curve=${python(settings.tone_curve)}`, ...(settings.background === 'blurred' ? ['background="blurred"'] : [])];
  return [
    'import os',
    'from pathlib import Path',
    '',
    'from drgs import Client',
    '',
    `with Client(${python(origin)}, token=os.environ["DRGS_TOKEN"]) as client:`,
    `    session = client.open_session(${python(asset)})`,
    ...edits.map((edit) => `    session.edit(${python(withoutNulls(edit))})`),
    ...(view ? [`    camera = ${python(view.world_from_camera)}`] : []),
    `    Path("picture.png").write_bytes(session.frame(${(frame ?? []).concat(view ? 'world_from_camera=camera' : []).join(', ')}))`,
    '',
  ].join('\n');
}

export function asCurl({ origin, session, view, settings }: Scene): string {
  const query = view ? `?${frameQuery(view, view, settings, settings.background === 'transparent')}` : '';
  return `curl -H "Authorization: Bearer $DRGS_TOKEN" -o picture.png '${origin}/api/sessions/${session}/frame.png${query}'\n`;
}
