/** One of the files that are offered: written by the server, or by the browser of what the server wrote. */

import { FILE_KINDS, SPLAT_KINDS, type DownloadFormat, type SplatFormat } from '../../session/constants.gen';
import * as api from '../../session/api';
import { transformSplats } from './splats/transform_splats';

export type SavedKind = (typeof FILE_KINDS)[number] | (typeof SPLAT_KINDS)[number];
export type SavedFormat = DownloadFormat | SplatFormat;
export interface MadeFile {
  content: Blob;
  /** To save it under. */
  name: string;
}

/** In the order in which they are offered: splats of the browser's behind those of the server's. */
export const SAVED_KINDS: SavedKind[] = FILE_KINDS.flatMap((kind) => (kind.format === 'spz' ? [kind, ...SPLAT_KINDS] : [kind]));

/** What the server writes on the way to a format. */
export const servedFormat = (format: SavedFormat): DownloadFormat => (format === 'sog' || format === 'compressed' ? 'ply3' : format);

/** `address`: of what the server writes. `onShare`: 0..1 of what the browser does then.
 *
 * Fails with a sentence; with an AbortError where `leaving` says so. */
export async function makeFile({ format, suffix }: SavedKind, address: string, onShare: (share: number) => void, leaving: AbortSignal): Promise<MadeFile> {
  const served = await api.exportedFile(address, leaving);
  if (format !== 'sog' && format !== 'compressed') return served;
  onShare(0);
  const content = await transformSplats(await served.content.arrayBuffer(), format, onShare, leaving);
  return { content, name: served.name.replace(/\.ply$/, suffix) };
}
