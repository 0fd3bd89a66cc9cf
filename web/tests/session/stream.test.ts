import { afterEach, beforeEach, expect, it, vi } from 'vitest';
import { CAMERA_NUMBER_SHIFT, FLAG_CONVERGED, FRAME_HEADER_BYTES, type ClientMessage } from '../../src/session/protocol.gen';
import { Stream } from '../../src/session/stream';

/** The other end of the connection: what the page sent, and a way to answer. */
class FakeSocket {
  static readonly OPEN = 1;
  static all: FakeSocket[] = [];
  readyState = FakeSocket.OPEN;
  binaryType = '';
  sent: ClientMessage[] = [];
  onopen = () => {};
  onmessage = (_: { data: string | ArrayBuffer }) => {};
  onclose = (_: { code: number; reason: string }) => {};
  constructor(readonly url: string) {
    FakeSocket.all.push(this);
  }
  send(text: string) {
    this.sent.push(JSON.parse(text) as ClientMessage);
  }
  close() {}
  say(message: object) {
    this.onmessage({ data: JSON.stringify(message) });
  }
  /** A frame whose header says so, before a picture of one byte. */
  show(frameId: number, flags: number, picture: number) {
    const bytes = new DataView(new ArrayBuffer(FRAME_HEADER_BYTES + 1));
    bytes.setUint16(2, flags, true);
    bytes.setUint32(4, frameId, true);
    bytes.setUint16(12, 800, true);
    bytes.setUint8(FRAME_HEADER_BYTES, picture);
    this.onmessage({ data: bytes.buffer });
  }
  greet() {
    this.onopen();
    this.say({ type: 'hello', log: { revision: 0, edits: [], can_undo: false, can_redo: false, appended: 0, undone: [] } });
  }
  take() {
    return this.sent.splice(0);
  }
}

const pose = (width: number) => ({ world_from_camera: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]] as never, fov_y_degrees: 40, width, height: 64 });
const settings = { exposure_stops: 0, background: 'environment' as const, spp_target: 8, bounces: 1, channel: 'final' as const, denoise: true };
type Change = Extract<ClientMessage, { key?: unknown }>;
const isChange = (message: ClientMessage): message is Change => 'key' in message;
const silent = { connection: () => {}, hello: () => {}, message: () => {}, waiting: () => {}, frame: () => {}, refused: () => {}, lost: async () => null };
let stream: Stream;

beforeEach(() => {
  vi.useFakeTimers();
  vi.stubGlobal('window', globalThis);
  vi.stubGlobal('WebSocket', FakeSocket);
  vi.stubGlobal('document', { hidden: false, addEventListener() {}, removeEventListener() {} });
  vi.stubGlobal('location', { protocol: 'http:', host: 'here' });
  FakeSocket.all = [];
  stream = new Stream('s', silent);
});
afterEach(() => {
  stream.close();
  vi.useRealTimers();
  vi.unstubAllGlobals();
});

it('sends new settings before the camera that is renumbered for them', () => {
  const [socket] = FakeSocket.all as [FakeSocket];
  socket.greet();
  const first = stream.sendCamera(pose(64));
  vi.advanceTimersByTime(100);
  socket.take();
  stream.sendSettings({ ...settings, channel: 'albedo' });
  const second = stream.sendCamera(pose(64));
  expect(second).not.toBe(first);
  vi.advanceTimersByTime(100);
  expect(socket.take().map((sent) => (sent.type === 'camera' ? sent.number : sent.type))).toEqual(['settings', second]);
  stream.sendCamera(pose(64)); // nothing new
  vi.advanceTimersByTime(100);
  expect(socket.take()).toEqual([]);
});

it('of many cameras sends the newest, and settings only once', () => {
  const [socket] = FakeSocket.all as [FakeSocket];
  socket.greet();
  stream.sendSettings(settings);
  for (let width = 64; width < 80; width++) stream.sendCamera(pose(width));
  vi.advanceTimersByTime(100);
  const sent = socket.take().filter((message) => message.type !== 'hello');
  expect(sent.map((message) => message.type)).toEqual(['settings', 'camera']);
  expect(sent[1]).toMatchObject({ width: 79 });
});

it('sends what was not answered again under the same key after a reconnection', async () => {
  const [first] = FakeSocket.all as [FakeSocket];
  first.greet();
  stream.sendEdit({ op: 'environment', rotation: 30 }, null);
  stream.undo();
  stream.splice(2, 0, 1, [], null);
  const before = first.take().filter(isChange);
  first.say({ type: 'accepted', id: before[0]!.id, revision: 1 });
  first.onclose({ code: 1006, reason: '' });
  await vi.advanceTimersByTimeAsync(5000);
  const [, second] = FakeSocket.all as [FakeSocket, FakeSocket];
  second.greet();
  const again = second.take().filter(isChange);
  expect(again).toEqual(before.slice(1));
  expect(new Set(before.map((message) => message.key)).size).toBe(3);
  expect(stream.idle).toBe(false);
  expect([stream.awaits('undo'), stream.awaits('redo')]).toEqual([true, false]);
});

/** A decoder that ends when the test says, and fails for pictures that start with 0. */
function slowDecoder() {
  const waiting = new Map<number, () => void>();
  const closed: number[] = [];
  vi.stubGlobal('createImageBitmap', async (blob: Blob) => {
    const [first] = new Uint8Array(await blob.arrayBuffer());
    await new Promise<void>((resolve) => waiting.set(first!, resolve));
    if (first === 0) throw new Error('no picture');
    return { first, close: () => closed.push(first!) };
  });
  const decode = async (first: number) => {
    await vi.waitUntil(() => waiting.has(first));
    waiting.get(first)!();
    await vi.advanceTimersByTimeAsync(1);
  };
  return { decode, closed };
}

it('decodes frames, says which camera they show, and acknowledges every one', async () => {
  const { decode, closed } = slowDecoder();
  const shown: unknown[] = [];
  stream.close();
  stream = new Stream('s', { ...silent, frame: (header, picture, camera) => shown.push([header.frameId, header.width, header.flags & FLAG_CONVERGED, (picture as never as { first: number }).first, camera]) });
  const socket = FakeSocket.all.at(-1)!;
  socket.greet();
  socket.take();
  socket.show(1, FLAG_CONVERGED | (200 << CAMERA_NUMBER_SHIFT), 7);
  await decode(7);
  expect(shown).toEqual([[1, 800, FLAG_CONVERGED, 7, 200]]);
  socket.show(2, 0, 0); // damaged
  await decode(0);
  expect(shown.length).toBe(1);
  socket.onmessage({ data: new ArrayBuffer(FRAME_HEADER_BYTES) }); // a header alone
  // The second of two is decoded first: the first is late then, and dropped.
  socket.show(3, 0, 3);
  socket.show(4, 0, 4);
  await decode(4);
  await decode(3);
  expect(shown.map((frame) => (frame as number[])[0])).toEqual([1, 4]);
  expect(closed).toEqual([3]);
  expect(socket.take()).toEqual([1, 2, 4, 3].map((frame_id) => ({ type: 'ack', frame_id })));
});

it('lets the server rest while nobody sees its pictures: they are acknowledged afterwards, all at once', async () => {
  const { decode } = slowDecoder();
  const [socket] = FakeSocket.all as [FakeSocket];
  socket.greet();
  socket.take();
  stream.holdFrames(true);
  for (const id of [1, 2]) {
    socket.show(id, 0, id);
    await decode(id);
  }
  expect(socket.take()).toEqual([]);
  stream.holdFrames(false);
  stream.holdFrames(false);
  expect(socket.take()).toEqual([{ type: 'ack', frame_id: 2 }]);
  stream.holdFrames(true);
  socket.show(3, 0, 3);
  await decode(3);
  socket.greet(); // another connection counts anew
  socket.take();
  stream.holdFrames(false);
  expect(socket.take()).toEqual([]);
});

it('answers a pick with what the server says of that very click', async () => {
  const [socket] = FakeSocket.all as [FakeSocket];
  socket.greet();
  socket.take();
  const [first, second] = [stream.pick(0.1, 0.2), stream.pick(0.3, 0.4)];
  const [a, b] = socket.take() as { id: number; x: number }[];
  socket.say({ type: 'picked', id: b!.id, hit: true });
  socket.say({ type: 'picked', id: a!.id, hit: false });
  expect([(await first).hit, (await second).hit]).toEqual([false, true]);
});

it('gives up the change that the server finds too large, and only that', async () => {
  const told: unknown[] = [];
  stream.close();
  stream = new Stream('s', { ...silent, message: (message) => told.push(message) });
  const first = FakeSocket.all.at(-1)!;
  first.greet();
  stream.undo();
  const large = stream.splice(2, 0, 1, [{ op: 'environment', rotation: 30 }], null);
  first.onclose({ code: 1009, reason: '' });
  await vi.advanceTimersByTimeAsync(5000);
  expect(told).toMatchObject([{ type: 'rejected', id: large, overtaken: false }]);
  const second = FakeSocket.all.at(-1)!;
  second.greet();
  expect(second.take().filter(isChange).map((message) => message.type)).toEqual(['undo']);
});

it('says how many changes wait for an answer, and has the server give up the one that it computes', () => {
  const waiting: number[] = [];
  stream.close();
  stream = new Stream('s', { ...silent, waiting: (count) => waiting.push(count) });
  const socket = FakeSocket.all.at(-1)!;
  socket.greet();
  socket.take();
  const long = stream.sendEdit({ op: 'simulate', scene: {}, time: 20 }, null);
  stream.undo();
  stream.cancelChange();
  expect(socket.take().map((message) => message.type)).toEqual(['edit', 'undo', 'cancel']);
  socket.say({ type: 'rejected', id: long, reason: 'This change was cancelled.', overtaken: false });
  expect(waiting).toEqual([1, 2, 1]);
});
