import { afterEach, beforeEach, expect, it, vi } from 'vitest';
import * as api from '../../src/session/api';
import { sendInParts, type UploadProgress } from '../../src/session/uploads';

vi.mock('../../src/session/api', async (original) => ({
  ...(await original<typeof api>()),
  announceUpload: vi.fn(async () => '/api/uploads/abc'),
  uploadOffset: vi.fn(),
  sendPart: vi.fn(),
  deleteUpload: vi.fn(async () => new Headers()),
}));

const PART = 8 << 20;
const BYTES = 2.5 * PART;
const file = { size: BYTES, slice: (from: number, to: number) => ({ size: Math.min(to, BYTES) - from }) } as unknown as Blob;
const away = new api.ApiError(0, 'away');

beforeEach(() => {
  vi.useFakeTimers();
  vi.stubGlobal('window', new EventTarget());
  // What the server holds.
  let arrived = 0;
  vi.mocked(api.uploadOffset).mockImplementation(async () => arrived);
  vi.mocked(api.sendPart).mockImplementation(async (_, offset, bytes) => {
    if (offset !== arrived) throw new api.ApiError(409, 'elsewhere');
    return (arrived = offset + bytes.size);
  });
});

afterEach(() => {
  vi.useRealTimers();
  vi.unstubAllGlobals();
  vi.clearAllMocks();
});

async function sent(leaving = new AbortController()): Promise<{ id: string; told: UploadProgress[] }> {
  const told: UploadProgress[] = [];
  const sending = sendInParts(file, 'a.zip', (progress) => told.push(progress), leaving.signal);
  sending.catch(() => {});
  await vi.runAllTimersAsync();
  return { id: await sending, told };
}

const offsets = () => vi.mocked(api.sendPart).mock.calls.map(([, offset]) => offset / PART);

it('sends a file in parts', async () => {
  const { id, told } = await sent();
  expect(id).toBe('abc');
  expect(offsets()).toEqual([0, 1, 2]);
  expect(told.map(({ share }) => share)).toEqual([0.4, 0.8, 1]);
});

it('goes on from what has arrived after a lost connection', async () => {
  const send = vi.mocked(api.sendPart).getMockImplementation()!;
  vi.mocked(api.sendPart).mockImplementationOnce(send).mockRejectedValueOnce(away);
  vi.mocked(api.uploadOffset).mockRejectedValueOnce(away).mockRejectedValueOnce(new api.ApiError(503, 'busy'));
  const { told } = await sent();
  expect(offsets()).toEqual([0, 1, 1, 2]);
  expect(told.filter(({ waiting }) => waiting).map(({ share }) => share)).toEqual([0.4, 0.4, 0.4]);
  expect(told.at(-1)).toEqual({ share: 1, waiting: false });
});

it('asks where the upload is when it is elsewhere', async () => {
  vi.mocked(api.sendPart).mockRejectedValueOnce(new api.ApiError(409, 'elsewhere'));
  await sent();
  expect(offsets()).toEqual([0, 0, 1, 2]);
});

it('ends where the server refuses the file', async () => {
  vi.mocked(api.announceUpload).mockRejectedValueOnce(new api.ApiError(413, 'too large'));
  await expect(sent()).rejects.toThrow('too large');
  vi.mocked(api.sendPart).mockRejectedValueOnce(new api.ApiError(404, 'forgotten'));
  await expect(sent()).rejects.toThrow('forgotten');
  expect(api.sendPart).toHaveBeenCalledTimes(1);
});

it('is given up while it waits, and the server forgets it', async () => {
  vi.mocked(api.sendPart).mockRejectedValue(away);
  vi.mocked(api.uploadOffset).mockRejectedValue(away);
  const leaving = new AbortController();
  setTimeout(() => leaving.abort(), 60_000);
  await expect(sent(leaving)).rejects.toMatchObject({ name: 'AbortError' });
  expect(api.deleteUpload).toHaveBeenCalledWith('/api/uploads/abc');
});
