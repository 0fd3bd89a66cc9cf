/** Left-hand panel: what a new asset is made of, builds under way or past, and the assets that can be opened. */

import { signal } from '@preact/signals';
import { useRef } from 'preact/hooks';
import * as api from '../../session/api';
import { captureAmong, chosenFiles } from '../../capture/dropped_files';
import { takeFile } from '../../capture/take_file';
import { zipOf, type PlacedFile } from '../../capture/zip';
import { buildSample } from '../../session/jobs';
import { assets } from '../../session/library';
import { attempt } from '../../session/notices';
import { openAsset, session } from '../../session/session';
import type { UploadProgress } from '../../session/uploads';
import { Bar, Section } from '../fields';
import { Icon } from '../icons';
import { foldPanels, libraryOpen } from '../layout';
import { build, BuildChoices } from './BuildChoices';
import { Captures } from './Captures';
import { Jobs } from './Jobs';

/** The upload under way, and what gives it up; null while there is none. */
const uploading = signal<({ name: string; leaving: AbortController } & UploadProgress) | null>(null);

/** Loose pictures, a film or a folder among the files are sent as one capture, which is shown before anything is built of it. */
export async function takeFiles(files: PlacedFile[]): Promise<void> {
  const { name, capture, others } = captureAmong(files);
  if (capture.length > 0) {
    uploading.value = { name, share: 0, waiting: false, leaving: new AbortController() };
    const zip = await attempt(zipOf(capture));
    if (zip) others.unshift(new File([zip], `${name}.zip`));
    uploading.value = null;
  }
  for (const file of others) {
    const leaving = new AbortController();
    const show = (progress: UploadProgress) => (uploading.value = { name: file.name, leaving, ...progress });
    show({ share: 0, waiting: false });
    await takeFile(file, show, leaving.signal);
    uploading.value = null;
  }
}

export function Library() {
  if (!libraryOpen.value) return null;
  return (
    <aside class="panel library" aria-label="Library">
      <NewBuild />
      <Captures />
      <Jobs />
      <Assets />
    </aside>
  );
}

function NewBuild() {
  const file = useRef<HTMLInputElement>(null);
  return (
    <Section title="New asset">
      <BuildChoices />
      <div class="buttons">
        <button class="primary" onClick={() => void buildSample(build.value)}>
          Build the sample
        </button>
        <button onClick={() => file.current?.click()}>Choose files…</button>
      </div>
      <input
        ref={file}
        class="visually-hidden"
        type="file"
        accept=".zip,.glb,.obj,.ply,.jpg,.jpeg,.png,.webp,.heic,.heif,.dng,.cr2,.cr3,.nef,.arw,.raf,.orf,.rw2,.mp4,.mov,.m4v,.webm,.mkv,.avi"
        multiple
        tabIndex={-1}
        aria-label="Capture or mesh"
        onChange={(event) => {
          const chosen = chosenFiles(event.currentTarget.files ?? []);
          event.currentTarget.value = '';
          void takeFiles(chosen);
        }}
      />
      <p class="hint">Or drop photos, their folder, a film, a capture (.zip), an asset’s folder, a mesh (.glb, .obj, .ply) or a light (.exr, .hdr) anywhere on this page.</p>
      {uploading.value && <Upload {...uploading.value} />}
    </Section>
  );
}

function Upload({ name, share, waiting, leaving }: { name: string; leaving: AbortController } & UploadProgress) {
  const arrived = `${Math.floor(100 * share)} %`;
  const label = waiting ? `The server does not answer. ${name} goes on by itself: ${arrived} have arrived` : share < 1 ? `Uploading ${name}: ${arrived}` : `The server is reading ${name}…`;
  return (
    <div class="upload">
      <p class={waiting ? 'warning' : 'facts'} role="status">
        {label}
      </p>
      <Bar label={`Upload of ${name}`} share={share} />
      {/\.zip$/.test(name) && <button onClick={() => leaving.abort()}>Give up</button>}
    </div>
  );
}

function Assets() {
  const list = assets.value;
  return (
    <Section title="Assets">
      {list === null ? (
        <p class="hint">Asking the server…</p>
      ) : list.length === 0 ? (
        <p class="hint">None yet. Build the sample to get one, or drop the folder of one that a command has built.</p>
      ) : (
        <ul class="assets">
          {list.map((asset) => (
            <li key={asset.id}>
              <button class="asset" aria-current={asset.id === session.value?.asset ? 'true' : undefined} onClick={() => void openAsset(asset.id).then(foldPanels)}>
                {asset.has_thumbnail ? <img src={api.assetThumb(asset)} alt="" loading="lazy" /> : <span class="no-thumb" aria-hidden="true"><Icon name="frame" /></span>}
                <span class="asset-text">
                  <strong>{asset.name}</strong>
                  <span>{asset.version > 1 ? `version ${asset.version} · ` : ''}{asset.surfel_count > 0 ? `${asset.surfel_count.toLocaleString()} surfels` : `${asset.face_count.toLocaleString()} faces`}</span>
                </span>
              </button>
            </li>
          ))}
        </ul>
      )}
    </Section>
  );
}
