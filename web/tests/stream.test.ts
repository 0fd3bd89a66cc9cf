import { afterEach, beforeEach, expect, it, vi } from 'vitest';
import type { ClientMessage } from '../src/protocol.gen';
import { Stream } from '../src/stream';

/** The other end of the connection: what the page sent, and a way to answer. */
class FakeSocket {
  static readonly OPEN = 1;
  static all: FakeSocket[] = [];
  readyState = FakeSocket.OPEN;
  binaryType = '';
  sent: ClientMessage[] = [];
  onopen = () => {};
  onmessage = (_: { data: string }) => {};
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
const silent = { connection: () => {}, hello: () => {}, message: () => {}, frame: () => {}, refused: () => {}, lost: async () => null };
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
