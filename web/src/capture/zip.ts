/** Names of the files in a zip, read from its directory at the end: enough to tell an asset from a capture before it is sent. */

const END_BYTES = 22;
const ENTRY_BYTES = 46;
/** The end of a zip may be followed by a comment of up to this many bytes. */
const LONGEST_COMMENT = 0xffff;

/** Empty where the directory is not found or is of the kind for archives over 4 GB. */
async function entryNames(zip: Blob): Promise<string[]> {
  const tailStart = Math.max(0, zip.size - END_BYTES - LONGEST_COMMENT);
  const tail = new DataView(await zip.slice(tailStart).arrayBuffer());
  let end = tail.byteLength - END_BYTES;
  while (end >= 0 && tail.getUint32(end, true) !== 0x06054b50) end--;
  if (end < 0) return [];
  const size = tail.getUint32(end + 12, true);
  const start = tail.getUint32(end + 16, true);
  const directory = new DataView(await zip.slice(start, start + size).arrayBuffer());
  const names: string[] = [];
  for (let at = 0; at + ENTRY_BYTES <= directory.byteLength && directory.getUint32(at, true) === 0x02014b50; ) {
    const nameBytes = directory.getUint16(at + 28, true);
    const name = new Uint8Array(directory.buffer, at + ENTRY_BYTES, Math.min(nameBytes, directory.byteLength - at - ENTRY_BYTES));
    names.push(new TextDecoder().decode(name));
    at += ENTRY_BYTES + nameBytes + directory.getUint16(at + 30, true) + directory.getUint16(at + 32, true);
  }
  return names;
}

/** Whether a zip is an asset: its manifest lies on top, or in the one folder there. */
export async function holdsAsset(zip: Blob): Promise<boolean> {
  return (await entryNames(zip)).some((name) => /^([^/]+\/)?asset\.json$/.test(name));
}

/** A file and where it lies in what was dropped: `photos/masks/a.png`, or its name alone. */
export interface PlacedFile {
  path: string;
  file: File;
}

/** Bytes that a zip can hold without the extension for larger ones. */
const MOST_BYTES = 0xffffffff;
/** Room kept for names and headers. */
const HEADERS_BYTES = 0x2000000;
const UTF8_NAMES = 0x0800;
/** 1 January 1980, the earliest date that a zip can tell. */
const DATE = 0x0021;

const CRC_TABLE = Uint32Array.from({ length: 256 }, (_, byte) => {
  let value = byte;
  for (let bit = 0; bit < 8; bit++) value = value & 1 ? (value >>> 1) ^ 0xedb88320 : value >>> 1;
  return value;
});

async function crc32(file: Blob): Promise<number> {
  let crc = 0xffffffff;
  const reader = file.stream().getReader();
  for (let part = await reader.read(); !part.done; part = await reader.read()) {
    for (const byte of part.value) crc = (crc >>> 8) ^ CRC_TABLE[(crc ^ byte) & 0xff]!;
  }
  return (crc ^ 0xffffffff) >>> 0;
}

/**
 * The files as one zip, not compressed, for pictures and films are already. The blob refers to the files, so nothing of them is held in memory.
 * Throws an Error with a sentence where they are more than a zip holds.
 */
export async function zipOf(files: PlacedFile[]): Promise<Blob> {
  const total = files.reduce((sum, { file }) => sum + file.size, 0);
  if (total > MOST_BYTES - HEADERS_BYTES || files.length > 0xffff) {
    throw new Error(`${files.length} files of ${Math.round(total / 1e6)} MB are more than can be sent at once: at most 65535 of 4250 MB.`);
  }
  const parts: BlobPart[] = [];
  const directory: BlobPart[] = [];
  let at = 0;
  let directoryBytes = 0;
  for (const { path, file } of files) {
    const name = new TextEncoder().encode(path);
    const crc = await crc32(file);
    // Of both headers: version, flags, method, time, date, checksum, sizes, length of the name.
    const facts = (view: DataView<ArrayBuffer>, from: number) => {
      view.setUint16(from, 20, true);
      view.setUint16(from + 2, UTF8_NAMES, true);
      view.setUint16(from + 8, DATE, true);
      view.setUint32(from + 10, crc, true);
      view.setUint32(from + 14, file.size, true);
      view.setUint32(from + 18, file.size, true);
      view.setUint16(from + 22, name.length, true);
    };
    const local = new DataView(new ArrayBuffer(30));
    local.setUint32(0, 0x04034b50, true);
    facts(local, 4);
    const central = new DataView(new ArrayBuffer(ENTRY_BYTES));
    central.setUint32(0, 0x02014b50, true);
    central.setUint16(4, 20, true);
    facts(central, 6);
    central.setUint32(42, at, true);
    parts.push(local, name, file);
    directory.push(central, name);
    at += local.byteLength + name.length + file.size;
    directoryBytes += ENTRY_BYTES + name.length;
  }
  const end = new DataView(new ArrayBuffer(END_BYTES));
  end.setUint32(0, 0x06054b50, true);
  end.setUint16(8, files.length, true);
  end.setUint16(10, files.length, true);
  end.setUint32(12, directoryBytes, true);
  end.setUint32(16, at, true);
  return new Blob([...parts, ...directory, end], { type: 'application/zip' });
}
