/** Writes SOG and compressed PLY of a PLY, by PlayCanvas' splat-transform: half a second to minutes, so beside the page. */

import { createChunkDataPool, logger, materializeToDataTable, MemoryFileSystem, MemoryReadFileSystem, readPly, WebPCodec, WorkerQueue, writeCompressedPly, writeSog } from '@playcanvas/splat-transform';
import webpAddress from '@playcanvas/splat-transform/lib/webp.wasm?url';
import type { Answer, Order } from './messages';

/** Of clustering harmonics for a SOG, which is nearly all of its time: as many as the command has. */
const CLUSTER_ROUNDS = 10;

WebPCodec.wasmUrl = webpAddress;
WorkerQueue.maxWorkers = 0; // this is one already
logger.setRenderer({
  handle: (event) => {
    if (event.kind === 'barTick' && event.name === 'k-means') answer({ share: event.current / event.total });
  },
});

function answer(said: Answer, transfer: ArrayBuffer[] = []): void {
  postMessage(said, { transfer });
}

async function write({ ply, format }: Order): Promise<ArrayBuffer> {
  const given = new MemoryReadFileSystem();
  given.set('given.ply', new Uint8Array(ply));
  const pool = createChunkDataPool();
  const source = await readPly(await given.createSource('given.ply'), pool);
  const dataTable = await materializeToDataTable(source, pool);
  const made = new MemoryFileSystem();
  if (format === 'sog') await writeSog({ filename: 'made', dataTable, bundle: true, iterations: CLUSTER_ROUNDS }, made);
  else await writeCompressedPly({ filename: 'made', dataTable }, made);
  return made.results.get('made')!.slice().buffer;
}

addEventListener('message', ({ data }: MessageEvent<Order>) => {
  write(data).then(
    (file) => answer({ file }, [file]),
    (error: unknown) => answer({ trouble: error instanceof Error ? error.message : String(error) }),
  );
});
