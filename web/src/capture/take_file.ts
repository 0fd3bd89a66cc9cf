/** Files dropped on the page or chosen: told apart by their names, and sent to where they belong. */

import { editLight } from '../edit/light';
import * as api from '../session/api';
import { openCapture, refreshCaptures } from '../session/captures';
import { refreshAssets, refreshEnvironments } from '../session/library';
import { attempt, notify } from '../session/notices';
import { openAsset } from '../session/session';
import { retryWhileAway, sendInParts, type UploadProgress } from '../session/uploads';
import { holdsAsset } from './zip';

/** Upload a light, an asset or a mesh, and show it; or a capture, and show what can be seen of it. Only captures can be given up (`leaving`). */
export async function takeFile(file: File, onProgress: (progress: UploadProgress) => void, leaving: AbortSignal): Promise<void> {
  const name = file.name.toLowerCase();
  const tell = (share: number) => onProgress({ share, waiting: false });
  if (/\.(exr|hdr)$/.test(name)) {
    const added = await attempt(api.uploadEnvironment(file, tell));
    if (!added) return;
    await attempt(refreshEnvironments());
    editLight({ file: added.name });
  } else if (/\.(glb|obj|ply)$/.test(name) || (name.endsWith('.zip') && (await holdsAsset(file)))) {
    const added = await attempt(api.uploadAsset(file, tell));
    if (!added) return;
    await attempt(refreshAssets());
    await openAsset(added.id);
  } else if (name.endsWith('.zip')) {
    const added = await attempt(sendCapture(file, onProgress, leaving));
    if (!added) return;
    await attempt(refreshCaptures());
    void openCapture(added);
  } else {
    notify(`“${file.name}” is none of the kinds that can be dropped here: photos, a film, a capture (.zip), an asset’s folder, a mesh (.glb, .obj, .ply) or a light (.exr, .hdr).`);
  }
}

async function sendCapture(zip: File, onProgress: (progress: UploadProgress) => void, leaving: AbortSignal) {
  const upload = await sendInParts(zip, zip.name, onProgress, leaving);
  return retryWhileAway(() => api.makeCapture(upload), () => onProgress({ share: 1, waiting: true }), leaving);
}
