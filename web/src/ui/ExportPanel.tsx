/** Pictures, files for other programs, and what is on screen as a script. */

import { signal } from '@preact/signals';
import * as api from '../api';
import { refreshAssets, startJob } from '../jobs';
import { attempt, libraryOpen, log, notify, session, settings } from '../state';
import { titleFor } from '../shortcuts';
import { viewNow } from '../viewpoint';
import { asCurl, asEdits, asPython } from '../scripts';
import { Choice, Section, Switch } from './fields';
import { Icon } from './icons';

const SIZES = { window: 'Window', hd: '1920×1080', square: '1024²', uhd: '3840×2160' } as const;
const size = signal<keyof typeof SIZES>('window');
const samples = signal('128');
const transparent = signal(false);
const rendering = signal(false);

function stillSize(): { width: number; height: number } {
  const { width, height } = viewNow.value!;
  return { window: { width, height }, hd: { width: 1920, height: 1080 }, square: { width: 1024, height: 1024 }, uhd: { width: 3840, height: 2160 } }[size.value];
}

/** A finished picture, rendered by the server for this camera. */
async function saveStill(): Promise<void> {
  const view = viewNow.value;
  const open = session.value;
  if (!view || !open) return;
  rendering.value = true;
  const query = api.frameQuery(view, stillSize(), { ...settings.value, spp_target: Number(samples.value) }, transparent.value);
  const picture = await attempt(api.stillPicture(open.id, query));
  rendering.value = false;
  if (picture) download(picture, `${open.assetName}.png`);
}

export function download(content: Blob, name: string): void {
  const link = document.createElement('a');
  link.href = URL.createObjectURL(content);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}

export function ExportPanel() {
  return (
    <>
      <Still />
      <Files />
      <Script />
    </>
  );
}

function Still() {
  return (
    <Section title="Picture">
      <Choice label="Size" value={size.value} options={Object.entries(SIZES).map(([value, text]) => ({ value: value as keyof typeof SIZES, text }))} onChange={(value) => (size.value = value)} />
      <Choice label="Samples a pixel" value={samples.value} options={['32', '128', '512'].map((value) => ({ value, text: value }))} onChange={(value) => (samples.value = value)} />
      <Switch label="Transparent background" value={transparent.value} onChange={(value) => (transparent.value = value)} />
      <div class="buttons">
        <button class="primary" disabled={rendering.value || !viewNow.value} onClick={() => void saveStill()}>
          <Icon name="camera" /> {rendering.value ? 'Rendering…' : 'Render PNG'}
        </button>
        <button title="72 pictures round the object, as MP4; a job" onClick={() => void renderTurntable()}>
          Turntable (MP4)
        </button>
      </div>
      <p class="hint">{titleFor('still', 'What is on screen is saved at once')}.</p>
    </Section>
  );
}

const TURNTABLE = { frames: 72, fps: 24, width: 800, height: 600 };

/** All round the object with its edits, as a job whose film is in the list of jobs. */
async function renderTurntable(): Promise<void> {
  const open = session.value!;
  libraryOpen.value = true;
  await startJob({
    kind: 'render',
    asset: open.asset,
    name: `${open.assetName}, turntable`,
    turntable: { frames: TURNTABLE.frames },
    variants: [{ name: 'edited', edits: log.value.edits }],
    video_fps: TURNTABLE.fps,
    width: TURNTABLE.width,
    height: TURNTABLE.height,
    spp: Number(samples.value),
    background: transparent.value ? 'transparent' : 'environment',
  });
}

const FILES: { format: api.ExportFormat; text: string; title: string }[] = [
  { format: 'glb', text: 'Mesh (GLB)', title: 'Mesh with metallic-roughness textures: Blender, three.js, Unreal, Unity' },
  { format: 'ply', text: 'Gaussians (2DGS PLY)', title: '2D Gaussians with the field names of 2DGS: SuperSplat' },
  { format: 'ply3', text: 'Gaussians (3DGS PLY)', title: 'The same as flat ellipsoids, for viewers that want three scales' },
  { format: 'usd', text: 'Scene (USD)', title: 'ParticleField surflets for OpenUSD 26' },
  { format: 'env', text: 'Light (EXR)', title: 'The environment that was recovered with the object' },
  { format: 'zip', text: 'Asset (ZIP)', title: 'Everything, to open here or with `drgs render`' },
];

function Files() {
  const open = session.value!;
  return (
    <Section title="Files">
      <ul class="files">
        {FILES.map(({ format, text, title }) => (
          <li>
            <a class="button" href={api.assetExport(open.asset, format)} download title={title}>
              <Icon name="download" /> {text}
            </a>
          </li>
        ))}
      </ul>
      {log.value.edits.length > 0 && (
        <>
          <p class="hint">These files hold the object without this session’s edits. A new version has them in it, and files of its own.</p>
          <div class="buttons">
            <button onClick={() => void saveVersion()}>Save a new version</button>
          </div>
        </>
      )}
    </Section>
  );
}

async function saveVersion(): Promise<void> {
  const saved = await attempt(api.saveVersion(session.value!.id));
  if (!saved) return;
  await attempt(refreshAssets());
  notify(`Saved as version ${saved.version}: it is in the list of assets.`, 'info');
}

function Script() {
  const copy = async (text: string, what: string) => {
    try {
      await navigator.clipboard.writeText(text);
      notify(`${what} is on the clipboard.`, 'info');
    } catch {
      notify('The browser did not allow writing to the clipboard.');
    }
  };
  const now = () => ({ origin: location.origin, asset: session.value!.asset, session: session.value!.id, edits: log.value.edits, view: viewNow.value, settings: settings.value });
  return (
    <Section title="As a script">
      <div class="buttons">
        <button onClick={() => void copy(asPython(now()), 'Python for this picture')}>Copy as Python</button>
        <button onClick={() => void copy(asCurl(now()), 'A curl command for this picture')}>Copy as curl</button>
        <button onClick={() => void copy(asEdits(log.value.edits), 'The list of edits')}>Copy edits (JSON)</button>
      </div>
      <p class="hint">Scripts read the token from DRGS_TOKEN; edits are what `drgs render --edits` takes.</p>
    </Section>
  );
}
