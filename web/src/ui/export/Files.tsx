/** The object as files for other programs, with or without what was done to it here. */

import { signal } from '@preact/signals';
import { FILE_KINDS, type DownloadFormat } from '../../session/constants.gen';
import * as api from '../../session/api';
import { log } from '../../session/edit_log';
import { refreshAssets } from '../../session/library';
import { attempt, notify } from '../../session/notices';
import { session } from '../../session/session';
import { download } from '../download';
import { Section, Switch } from '../fields';
import { Icon } from '../icons';

const withEdits = signal(true);
/** The file that the server is writing; null while there is none. */
const writing = signal<{ format: DownloadFormat; leaving: AbortController } | null>(null);

/** Bytes of the files written so far, by address; after further edits a file may take some more or less. */
const sizes = signal<Record<string, number>>({});

export function Files() {
  const open = session.value!;
  const edited = log.value.edits.length > 0;
  const address = (format: DownloadFormat) => (edited && withEdits.value ? api.sessionExport(open.id, format) : api.assetExport(open.asset, format));
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
