/** The object as files for other programs, with or without what was done to it here. */

import { signal } from '@preact/signals';
import { DEFAULT_FACES, FEWEST_FACES, FILE_KINDS, MOST_FACES } from '../../session/constants.gen';
import * as api from '../../session/api';
import { log } from '../../session/edit_log';
import { refreshAssets } from '../../session/library';
import { attempt, notify } from '../../session/notices';
import { session } from '../../session/session';
import { download } from '../download';
import { NumberField, Section, Switch } from '../fields';
import { Icon } from '../icons';
import { makeFile, SAVED_KINDS, servedFormat, type MadeFile, type SavedFormat, type SavedKind } from './make_file';

const withEdits = signal(true);
/** The most that textured meshes have. */
const mostFaces = signal(DEFAULT_FACES);
/** The file that is being written; null while there is none. */
const writing = signal<{ format: SavedFormat; leaving: AbortController } | null>(null);
/** How much of it the browser has done, 0..1; null while the server writes. */
const share = signal<number | null>(null);

const textured = new Set<SavedFormat>(FILE_KINDS.filter((kind) => kind.textured).map((kind) => kind.format));

/** Bytes of the files written so far, by format and address; after further edits a file may take some more or less. Where there is none, the server's sentence why. */
const sizes = signal<Record<string, number | string>>({});

/** What the browser made last of each format, for it can take minutes; `of`: what it was made of. */
const kept = new Map<SavedFormat, { of: string; file: MadeFile }>();

export function Files() {
  const open = session.value!;
  const edited = log.value.edits.length > 0;
  const address = (format: SavedFormat) => {
    const faces = textured.has(format) && mostFaces.value !== DEFAULT_FACES ? mostFaces.value : null;
    const served = servedFormat(format);
    return edited && withEdits.value ? api.sessionExport(open.id, served, faces) : api.assetExport(open.asset, served, faces);
  };
  const place = (format: SavedFormat) => `${format} ${address(format)}`;
  const make = async (kind: SavedKind, leaving: AbortController) => {
    const key = place(kind.format);
    const of = `${key} ${log.value.revision}`;
    const before = kept.get(kind.format);
    if (before?.of === of) return before.file;
    writing.value = { format: kind.format, leaving };
    share.value = null;
    const file = await makeFile(kind, address(kind.format), (done) => (share.value = done), leaving.signal).finally(() => (writing.value = null));
    sizes.value = { ...sizes.value, [key]: file.content.size };
    if (servedFormat(kind.format) !== kind.format) kept.set(kind.format, { of, file });
    return file;
  };
  const save = async (kind: SavedKind) => {
    if (writing.value) return;
    const file = await attempt(make(kind, new AbortController()));
    if (file) download(file.content, file.name);
  };
  const compare = async () => {
    const leaving = new AbortController();
    // What takes longest comes last: by then the others are there to look at.
    for (const kind of [...SAVED_KINDS].sort((a, b) => Number(a.format === 'sog') - Number(b.format === 'sog'))) {
      const key = place(kind.format);
      if (sizes.value[key] !== undefined) continue;
      const absent = (error: unknown) => {
        if (!(error instanceof api.ApiError && error.status === 422)) throw error;
        sizes.value = { ...sizes.value, [key]: error.message };
        return true;
      };
      if (!(await attempt(make(kind, leaving).catch(absent)))) return;
    }
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
        {SAVED_KINDS.map((kind) => (
          <li>
            <a
              class="button"
              href={address(kind.format)}
              download
              title={reasonFor(sizes.value[place(kind.format)]) ?? kind.description}
              aria-disabled={writing.value !== null}
              onClick={(event) => {
                event.preventDefault();
                void save(kind);
              }}
            >
              <Icon name="download" /> {kind.title}
              <span class="dim">{writing.value?.format === kind.format ? progress() : sizeInWords(sizes.value[place(kind.format)])}</span>
            </a>
            {writing.value?.format === kind.format && (
              <button class="ghost" aria-label={`Cancel ${kind.title}`} onClick={() => writing.value?.leaving.abort()}>
                Cancel
              </button>
            )}
          </li>
        ))}
      </ul>
      <div class="buttons">
        <button title="Writes each of these files once, for its size alone; the SOG of a large object takes minutes" disabled={writing.value !== null} onClick={() => void compare()}>
          Compare sizes
        </button>
      </div>
      <p class="visually-hidden" role="status">
        {writing.value ? `The ${share.value === null ? 'server' : 'browser'} is writing the file…` : ''}
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

const progress = () => (share.value ? `${Math.round(100 * share.value)} %` : 'writing…');

const reasonFor = (size: number | string | undefined) => (typeof size === 'string' ? size : null);

function sizeInWords(bytes: number | string | undefined): string {
  if (bytes === undefined) return '';
  if (typeof bytes === 'string') return 'none';
  return bytes < 1e6 ? `${Math.ceil(bytes / 1e3)} kB` : `${(bytes / 1e6).toFixed(1)} MB`;
}
