/** Left-hand panel: what a new asset is made of, builds under way or past, and the assets that can be opened. */

import { signal } from '@preact/signals';
import { useRef } from 'preact/hooks';
import * as api from '../../session/api';
import { captureAmong, chosenFiles } from '../../capture/dropped_files';
import { takeFile } from '../../capture/take_file';
import { zipOf, type PlacedFile } from '../../capture/zip';
import { buildSample, type BuildChoice } from '../../session/jobs';
import { assets } from '../../session/library';
import { attempt } from '../../session/notices';
import { openAsset, session } from '../../session/session';
import { Bar, Choice, Section } from '../fields';
import { Icon } from '../icons';
import { libraryOpen } from '../layout';
import { Jobs } from './Jobs';

const build = signal<BuildChoice>({ preset: 'fast', binding: 'particles', light: 'auto' });
/** Share of the upload under way; null while there is none. */
const uploading = signal<{ name: string; share: number } | null>(null);

/** Loose pictures, a film or a folder among the files are sent as one capture. */
export async function takeFiles(files: PlacedFile[]): Promise<void> {
  const { name, capture, others } = captureAmong(files);
  if (capture.length > 0) {
    uploading.value = { name, share: 0 };
    const zip = await attempt(zipOf(capture));
    if (zip) others.unshift(new File([zip], `${name}.zip`));
    uploading.value = null;
  }
  for (const file of others) {
    uploading.value = { name: file.name, share: 0 };
    await takeFile(file, build.value, (share) => (uploading.value = { name: file.name, share }));
    uploading.value = null;
  }
}

export function Library() {
  if (!libraryOpen.value) return null;
  return (
    <aside class="panel library" aria-label="Library">
      <NewBuild />
      <Jobs />
      <Assets />
    </aside>
  );
}

function NewBuild() {
  const file = useRef<HTMLInputElement>(null);
  return (
    <Section title="New asset">
      <Choice
        label="Quality"
        value={build.value.preset}
        options={[
          { value: 'draft', text: 'Draft', title: 'About a minute: to see whether the capture works' },
          { value: 'fast', text: 'Fast', title: 'Some minutes' },
          { value: 'full', text: 'Full', title: 'Up to an hour: the best this capture gives' },
        ]}
        onChange={(preset) => (build.value = { ...build.value, preset })}
      />
      <details class="fold">
        <summary>Advanced</summary>
        <Choice
          label="Gaussians lie"
          value={build.value.binding}
          options={[
            { value: 'particles', text: 'As fitted', title: 'Where they were fitted, carried along by the mesh: the sharper pictures' },
            { value: 'mesh', text: 'On the mesh', title: 'Rebuilt on its faces, one a face: they follow every deformation exactly, highlights are a little softer' },
          ]}
          onChange={(binding) => (build.value = { ...build.value, binding })}
        />
        <Choice
          label="Lamps stood still with"
          value={build.value.light}
          options={[
            { value: 'auto', text: 'Auto', title: 'By what is around the object in the pictures, and by how its brightness changes' },
            { value: 'object', text: 'The object', title: 'The camera went around it' },
            { value: 'camera', text: 'The camera', title: 'The object stood on a turntable' },
          ]}
          onChange={(light) => (build.value = { ...build.value, light })}
        />
      </details>
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
        accept=".zip,.glb,.obj,.ply,.jpg,.jpeg,.png,.webp,.heic,.heif,.mp4,.mov,.m4v,.webm,.mkv,.avi"
        multiple
        tabIndex={-1}
        aria-label="Capture or mesh"
        onChange={(event) => {
          const chosen = chosenFiles(event.currentTarget.files ?? []);
          event.currentTarget.value = '';
          void takeFiles(chosen);
        }}
      />
      <p class="hint">Or drop photos, their folder, a film, a capture (.zip), a mesh (.glb, .obj, .ply) or a light (.exr, .hdr) anywhere on this page.</p>
      {uploading.value && <Upload {...uploading.value} />}
    </Section>
  );
}

function Upload({ name, share }: { name: string; share: number }) {
  const label = share < 1 ? `Uploading ${name}` : `The server is reading ${name}…`;
  return (
    <div role="status">
      <p class="facts">{label}</p>
      <Bar label={label} share={share} />
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
        <p class="hint">None yet. Build the sample to get one.</p>
      ) : (
        <ul class="assets">
          {list.map((asset) => (
            <li key={asset.id}>
              <button class="asset" aria-current={asset.id === session.value?.asset ? 'true' : undefined} onClick={() => void openAsset(asset.id)}>
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
