/** What was dropped or chosen, folders opened, and which of it is one capture: loose pictures, a film, a whole folder. */

import type { PlacedFile } from './zip';

const PICTURE = /\.(jpe?g|png|webp|hei[cf]|dng|cr[23]|nef|arw|raf|orf|rw2)$/i;
const FILM = /\.(mp4|mov|m4v|webm|mkv|avi)$/i;

/** All files of a drop, those of dropped folders by their paths. Hidden files stay behind. */
export async function droppedFiles(transfer: DataTransfer): Promise<PlacedFile[]> {
  // Entries are gone once the event is over: taken before anything is waited for.
  const entries = [...transfer.items].map((item) => item.webkitGetAsEntry?.() ?? null);
  if (entries.every((entry) => entry === null)) return chosenFiles(transfer.files);
  const found = await Promise.all(entries.map((entry) => (entry ? filesBelow(entry) : [])));
  return found.flat();
}

export function chosenFiles(files: Iterable<File>): PlacedFile[] {
  return [...files].map((file) => ({ path: file.webkitRelativePath || file.name, file }));
}

async function filesBelow(entry: FileSystemEntry): Promise<PlacedFile[]> {
  if (entry.name.startsWith('.')) return [];
  if (entry.isFile) {
    const file = await new Promise<File>((resolve, reject) => (entry as FileSystemFileEntry).file(resolve, reject));
    return [{ path: entry.fullPath.replace(/^\//, ''), file }];
  }
  const reader = (entry as FileSystemDirectoryEntry).createReader();
  const found: PlacedFile[] = [];
  // A reader gives a hundred entries at a time, and none at the end.
  for (;;) {
    const some = await new Promise<FileSystemEntry[]>((resolve, reject) => reader.readEntries(resolve, reject));
    if (some.length === 0) return found;
    for (const below of some) found.push(...(await filesBelow(below)));
  }
}

/** The capture among the files, and the others, each of which is something by itself. */
export function captureAmong(files: PlacedFile[]): { name: string; capture: PlacedFile[]; others: File[] } {
  const belongs = ({ path }: PlacedFile) => path.includes('/') || PICTURE.test(path) || FILM.test(path);
  const capture = files.filter(belongs);
  const first = capture[0]?.path ?? '';
  const folder = first.includes('/') ? first.split('/')[0]! : '';
  const name = folder || (capture.length === 1 ? first.replace(/\.[^.]*$/, '') : 'photographs');
  return { name, capture, others: files.filter((file) => !belongs(file)).map(({ file }) => file) };
}
