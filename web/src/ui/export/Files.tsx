/** The object as files for other programs, with or without what was done to it here. */

import { signal } from '@preact/signals';
import { DEFAULT_FACES, FEWEST_FACES, FILE_KINDS, MOST_FACES, type DownloadFormat } from '../../session/constants.gen';
import * as api from '../../session/api';
import { log } from '../../session/edit_log';
import { refreshAssets } from '../../session/library';
import { attempt, notify } from '../../session/notices';
import { session } from '../../session/session';
import { download } from '../download';
import { NumberField, Section, Switch } from '../fields';
import { Icon } from '../icons';

const withEdits = signal(true);
/** The most that textured meshes have. */
const mostFaces = signal(DEFAULT_FACES);
/** The file that the server is writing; null while there is none. */
const writing = signal<{ format: DownloadFormat; leaving: AbortController } | null>(null);

const textured = new Set(FILE_KINDS.filter((kind) => kind.textured).map((kind) => kind.format));

/** Bytes of the files written so far, by address; after further edits a file may take some more or less. */
const sizes = signal<Record<string, number>>({});

export function Files() {
  const open = session.value!;
  const edited = log.value.edits.length > 0;
  const address = (format: DownloadFormat) => {
    const faces = textured.has(format) && mostFaces.value !== DEFAULT_FACES ? mostFaces.value : null;
    return edited && withEdits.value ? api.sessionExport(open.id, format, faces) : api.assetExport(open.asset, format, faces);
  };
  const save = async (format: DownloadFormat) => {
    if (writing.value) return;
    const leaving = new AbortController();
    writing.value = { format, leaving };
    const file = await attempt(api.exportedFile(address(format), leaving.signal));
    writing.value = null;
    if (!file) return;
    sizes.value = { ...sizes.value, [address(format)]: file.content.size };
    download(file.content, file.name);
  };
  return (
    <Section title="Files">
      {edited && (
        <Switch label="With this session’s edits" title="VertexMaterials, light and shape as they are on screen; off: as captured" value={withEdits.value} onChange={(value) => (withEdits.value = value)} />
      )}
      <NumberField
        label="Faces of textured meshes"
        title="The most that the mesh of a GLB or USDZ has; the detail of those left out goes into its textures"
        value={mostFaces.value}
        min={FEWEST_FACES}
        max={MOST_FACES}
        step={1}
        onEnter={(count) => (mostFaces.value = Math.round(count))}
      />
      <ul class="files">
        {FILE_KINDS.map(({ format, title, description }) => (
          <li>
            <a
              class="button"
              href={address(format)}
              download
              title={description}
              aria-disabled={writing.value !== null}
              onClick={(event) => {
                event.preventDefault();
                void save(format);
              }}
            >
              <Icon name="download" /> {title}
              {writing.value?.format === format ? <span class="dim">is being written…</span> : <span class="dim">{sizeInWords(sizes.value[address(format)])}</span>}
            </a>
            {writing.value?.format === format && (
              <button class="ghost" aria-label={`Cancel ${title}`} onClick={() => writing.value?.leaving.abort()}>
                Cancel
              </button>
            )}
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

function sizeInWords(bytes: number | undefined): string {
  if (bytes === undefined) return '';
  return bytes < 1e6 ? `${Math.ceil(bytes / 1e3)} kB` : `${(bytes / 1e6).toFixed(1)} MB`;
}
