/** Four lights beside each other: finished pictures of what is on screen, each under an environment of its own. */

import { signal } from '@preact/signals';
import { useEffect, useRef } from 'preact/hooks';
import { editLight, light, restoreCapturedLight } from '../edit/light';
import { environmentTitle } from '../edit/sun_and_sky';
import * as api from '../session/api';
import { edits, log } from '../session/edit_log';
import { environments } from '../session/library';
import { attempt } from '../session/notices';
import { session, settings } from '../session/session';
import { aimNow } from '../session/view';
import { worldFromCamera } from '../stage/camera/camera_path';
import { Icon } from './icons';
import { lightsOpen } from './layout';

const CELLS = 4;
/** Of a picture, with so many samples a pixel, denoised: small, for the server's viewers want their turns too. */
const SIZE = { width: 400, height: 300 };
const SAMPLES = 32;

/** Names of environments, one a cell. */
const chosen = signal<string[]>([]);
/** Address of the picture in each cell, and what it shows; null while it is rendered. */
const pictures = signal<({ address: string; of: string } | null)[]>([]);

const titleOf = (name: string) => (name === api.CAPTURED_LIGHT ? 'Captured' : environmentTitle(name));

/** The light in force first, then what else there is. */
function chooseAtFirst(): void {
  const now = light.value.file ?? api.CAPTURED_LIGHT;
  const all = [now, api.CAPTURED_LIGHT, ...environments.value.map(({ name }) => name)];
  chosen.value = [...new Set(all)].slice(0, CELLS);
}

/** What a cell is to show: pictures of it stay as long as it is the same. */
function wantedOf(name: string): string | null {
  const aim = aimNow.value;
  if (!aim) return null;
  // What the camera turns round is in the middle: no panel covers a part of these pictures.
  const view = { ...SIZE, fov_y_degrees: aim.fov_y_degrees, world_from_camera: worldFromCamera(aim) };
  const { background } = settings.value;
  const query = api.frameQuery(view, SIZE, { ...settings.value, channel: 'final', spp_target: SAMPLES, denoise: true }, background !== 'environment' && background !== 'blurred');
  return `${query}&environment=${encodeURIComponent(name)}`;
}

/** One picture after the other, so that the first is there soon. */
async function fill(leaving: AbortSignal): Promise<void> {
  const open = session.value;
  const of = log.value.digest ?? String(log.value.revision);
  for (let cell = 0; open && cell < chosen.value.length; cell++) {
    const query = wantedOf(chosen.value[cell]!);
    if (!query) return;
    const wanted = `${of} ${query}`;
    if (pictures.value[cell]?.of === wanted) continue;
    put(cell, null);
    const picture = await attempt(api.stillPicture(open.id, query, 'png', leaving));
    if (leaving.aborted) return;
    if (picture) put(cell, { address: URL.createObjectURL(picture), of: wanted });
  }
}

function put(cell: number, picture: { address: string; of: string } | null): void {
  const before = pictures.value[cell];
  if (before) URL.revokeObjectURL(before.address);
  pictures.value = Array.from({ length: CELLS }, (_, k) => (k === cell ? picture : (pictures.value[k] ?? null)));
}

function use(name: string): void {
  if (name === api.CAPTURED_LIGHT) restoreCapturedLight();
  else editLight({ file: name });
  lightsOpen.value = false;
}

export function LightsDialog() {
  const dialog = useRef<HTMLDialogElement>(null);
  const open = lightsOpen.value && session.value !== null;
  useEffect(() => {
    if (!open) return dialog.current?.close();
    chooseAtFirst();
    dialog.current?.showModal();
  }, [open]);
  const choice = chosen.value.join('\n');
  useEffect(() => {
    if (!open) return;
    const leaving = new AbortController();
    void fill(leaving.signal);
    return () => leaving.abort();
  }, [open, choice, edits.value]);
  const names = [api.CAPTURED_LIGHT, ...environments.value.map(({ name }) => name)];
  return (
    <dialog ref={dialog} class="capture lights" aria-labelledby="lights-title" onClose={() => (lightsOpen.value = false)} onClick={(event) => event.target === dialog.current && dialog.current?.close()}>
      <header>
        <h2 id="lights-title">Lights compared</h2>
        <button class="ghost" aria-label="Close" onClick={() => dialog.current?.close()}>
          <Icon name="close" />
        </button>
      </header>
      <div class="four">
        {chosen.value.map((name, cell) => (
          <figure>
            {pictures.value[cell] ? <img src={pictures.value[cell]!.address} alt={`The object under ${titleOf(name)}`} /> : <p role="status">Rendering…</p>}
            <figcaption>
              <select aria-label={`Light ${cell + 1}`} value={name} onChange={(event) => (chosen.value = chosen.value.with(cell, event.currentTarget.value))}>
                {[...new Set([name, ...names])].map((other) => (
                  <option value={other}>{titleOf(other)}</option>
                ))}
              </select>
              <button onClick={() => use(name)}>Use</button>
            </figcaption>
          </figure>
        ))}
      </div>
      <p class="hint">As on screen, with {SAMPLES} samples a pixel; every light is turned and as bright as the one in force.</p>
    </dialog>
  );
}
