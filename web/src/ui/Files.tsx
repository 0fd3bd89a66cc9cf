/** The object as files for other programs, with or without what was done to it here. */

import { signal } from '@preact/signals';
import * as api from '../api';
import { download } from '../download';
import { refreshAssets } from '../jobs';
import { attempt, log, notify, session } from '../state';
import { Section, Switch } from './fields';
import { Icon } from './icons';

const FILES: { format: api.ExportFormat; text: string; title: string }[] = [
  { format: 'glb', text: 'Mesh (GLB)', title: 'Mesh with metallic-roughness textures: Blender, three.js, Unreal, Unity' },
  { format: 'ply', text: 'Gaussians (2DGS PLY)', title: '2D Gaussians with the field names of 2DGS: SuperSplat' },
  { format: 'ply3', text: 'Gaussians (3DGS PLY)', title: 'The same as flat ellipsoids, for viewers that want three scales' },
  { format: 'usd', text: 'Scene (USD)', title: 'ParticleField surflets for OpenUSD 26' },
  { format: 'env', text: 'Light (EXR)', title: 'The environment: with edits the chosen one, turned and dimmed; else the one recovered with the object' },
  { format: 'zip', text: 'Asset (ZIP)', title: 'Everything, to open here or with `drgs render`' },
];

const withEdits = signal(true);
/** The file that the server is writing; null while there is none. */
const writing = signal<api.ExportFormat | null>(null);

export function Files() {
  const open = session.value!;
  const edited = log.value.edits.length > 0;
  const address = (format: api.ExportFormat) => (edited && withEdits.value ? api.sessionExport(open.id, format) : api.assetExport(open.asset, format));
  const save = async (format: api.ExportFormat) => {
    if (writing.value) return;
    writing.value = format;
    const file = await attempt(api.exportedFile(address(format)));
    writing.value = null;
    if (file) download(file.content, file.name);
  };
  return (
    <Section title="Files">
      {edited && (
        <Switch label="With this session’s edits" title="Materials, light and shape as they are on screen; off: as captured" value={withEdits.value} onChange={(value) => (withEdits.value = value)} />
      )}
      <ul class="files">
        {FILES.map(({ format, text, title }) => (
          <li>
            <a
              class="button"
              href={address(format)}
              download
              title={title}
              aria-disabled={writing.value !== null}
              onClick={(event) => {
                event.preventDefault();
                void save(format);
              }}
            >
              <Icon name="download" /> {text}
              {writing.value === format && <span class="dim">is being written…</span>}
            </a>
          </li>
        ))}
      </ul>
      <p class="visually-hidden" role="status">
        {writing.value ? 'The server is writing the file…' : ''}
      </p>
      {edited && (
        <>
          <p class="hint">A version is an asset of its own with these edits in it, beside the one as captured.</p>
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
