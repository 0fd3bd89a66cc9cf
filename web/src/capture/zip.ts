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
