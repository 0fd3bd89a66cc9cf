/** Files dropped on the page or chosen: told apart by their names, and sent to where they belong. */

import { editLight } from '../edit/light';
import { buildCapture, type BuildChoice } from '../session/jobs';
import { refreshAssets, refreshEnvironments } from '../session/library';
import { attempt, notify } from '../session/notices';
import { openAsset } from '../session/session';
import { holdsAsset } from './zip';
import * as api from '../session/api';

/** Upload a light, an asset, a mesh or a capture; a capture is built as `choice` says. `onProgress`: share of the upload, 0..1. */
export async function takeFile(file: File, choice: BuildChoice, onProgress: (share: number) => void): Promise<void> {
  const name = file.name.toLowerCase();
  if (/\.(exr|hdr)$/.test(name)) {
    const added = await attempt(api.uploadEnvironment(file, onProgress));
    if (!added) return;
    await attempt(refreshEnvironments());
    editLight({ file: added.name });
  } else if (/\.(glb|obj|ply)$/.test(name) || (name.endsWith('.zip') && (await holdsAsset(file)))) {
    const added = await attempt(api.uploadAsset(file, onProgress));
    if (!added) return;
    await attempt(refreshAssets());
    await openAsset(added.id);
  } else if (name.endsWith('.zip')) {
    await buildCapture(file, choice, onProgress);
  } else {
    notify(`“${file.name}” is none of the kinds that can be dropped here: photos, a film, a capture (.zip), a mesh (.glb, .obj, .ply) or a light (.exr, .hdr).`);
  }
}
