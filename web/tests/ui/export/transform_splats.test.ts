import { afterEach, beforeEach, expect, it, vi } from 'vitest';
import type { Answer } from '../../../src/ui/export/splats/messages';
import { transformSplats } from '../../../src/ui/export/splats/transform_splats';

class Stand {
  static last: Stand;
  onmessage: ((event: { data: Answer }) => void) | null = null;
  onerror: ((event: { message: string; preventDefault(): void }) => void) | null = null;
  orders: unknown[] = [];
  ended = false;

  constructor() {
    Stand.last = this;
  }

  postMessage(order: unknown) {
    this.orders.push(order);
  }

  terminate() {
    this.ended = true;
  }

  say(data: Answer) {
    this.onmessage!({ data });
  }
}

const ply = new ArrayBuffer(8);

beforeEach(() => void vi.stubGlobal('Worker', Stand));
afterEach(() => expect(Stand.last.ended).toBe(true));

it('tells how far the work is, and gives the file', async () => {
  const shares: number[] = [];
  const made = transformSplats(ply, 'sog', (share) => shares.push(share), new AbortController().signal);
  expect(Stand.last.orders).toEqual([{ ply, format: 'sog' }]);
  Stand.last.say({ share: 0.4 });
  Stand.last.say({ share: 1 });
  Stand.last.say({ file: new Uint8Array([1, 2, 3]).buffer });
  expect(new Uint8Array(await (await made).arrayBuffer())).toEqual(new Uint8Array([1, 2, 3]));
  expect(shares).toEqual([0.4, 1]);
});

it('says in one sentence what went wrong, and what else writes the file', async () => {
  const made = transformSplats(ply, 'compressed', () => {}, new AbortController().signal);
  Stand.last.say({ trouble: 'No memory is left.' });
  await expect(made).rejects.toThrow('The browser could not write this file (No memory is left); `drgs export` writes it where Node is installed.');
});

it('says so where its program does not load', async () => {
  const made = transformSplats(ply, 'compressed', () => {}, new AbortController().signal);
  Stand.last.onerror!({ message: '', preventDefault: () => {} });
  await expect(made).rejects.toThrow('(its program did not load)');
});

it('ends at once where it is given up', async () => {
  const leaving = new AbortController();
  const made = transformSplats(ply, 'sog', () => {}, leaving.signal);
  leaving.abort();
  await expect(made).rejects.toMatchObject({ name: 'AbortError' });
});

it('does not begin where it was given up before', async () => {
  await expect(transformSplats(ply, 'sog', () => {}, AbortSignal.abort())).rejects.toMatchObject({ name: 'AbortError' });
  expect(Stand.last.orders).toEqual([]);
});
