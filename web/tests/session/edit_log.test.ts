import { beforeEach, expect, it, vi } from 'vitest';
import { appliedEdits, attachStream, broken, commitDraft, draft, draftEdit, edits, editsToRestore, goTo, log, receiveAccepted, receiveChange, receiveLog, receiveRejected, resetLog, reviseEdits, sendEdit, undo } from '../../src/session/edit_log';
import type { Edit, EditLog } from '../../src/session/protocol.gen';
import type { Stream } from '../../src/session/stream';

const turned = (rotation: number): Edit => ({ op: 'environment', rotation });
const isLight = (edit: Edit) => edit.op === 'environment';
const logWith = (revision: number, ...rotations: number[]): EditLog => ({ revision, edits: rotations.map(turned), can_undo: rotations.length > 0, can_redo: false, appended: rotations.length, undone: [] });

/** The other end: what was sent there, each under the next id. */
let sent: unknown[] = [];
let idle = true;
/** Whether the server has not answered an undo. */
let undoing = false;

beforeEach(() => {
  sent = [];
  idle = true;
  undoing = false;
  let id = 0;
  const record = (...what: unknown[]) => {
    sent.push(what);
    return ++id;
  };
  const stream = {
    get idle() {
      return idle;
    },
    sendEdit: (edit: Edit, key: string | null) => record('edit', edit, key),
    splice: (revision: number, start: number, remove: number, put: Edit[], key: string | null) => record('splice', revision, start, remove, put, key),
    undo: () => record('undo'),
    redo: () => record('redo'),
    awaits: (type: string) => undoing && type === 'undo',
  };
  attachStream(stream as unknown as Stream);
  resetLog(logWith(1, 10, 20));
});

it('an edit is in force before the server has it, once, and an edit that changes nothing is not sent', () => {
  sendEdit(turned(30), 'drag');
  sendEdit(turned(30), 'drag');
  expect(edits.value).toEqual([10, 20, 30].map(turned));
  receiveAccepted(1, 2);
  expect(edits.value).toHaveLength(3);
  receiveLog(logWith(2, 10, 20, 30));
  expect(edits.value).toEqual(log.value.edits);
  expect(sent).toEqual([['edit', turned(30), 'drag']]);
});

it('the last edit made again is not lost while an undo, or a change of the list, takes it back', () => {
  undoing = true;
  sendEdit(turned(20), null);
  undoing = false;
  resetLog(logWith(1, 10, 20));
  reviseEdits(() => []);
  sendEdit(turned(20), null);
  expect(sent.filter((what) => (what as string[])[0] === 'edit')).toEqual([0, 1].map(() => ['edit', turned(20), null]));
});

it('a splice waits for what was sent before it, and then counts in the newest log', () => {
  sendEdit(turned(30), null);
  idle = false;
  reviseEdits(() => [turned(10), turned(30)]);
  expect(edits.value).toEqual([10, 30].map(turned));
  expect(sent).toHaveLength(1);
  receiveLog(logWith(2, 10, 20, 30));
  idle = true;
  receiveAccepted(1, 2);
  expect(sent[1]).toEqual(['splice', 2, 1, 1, [], null]);
});

it('of a gesture only the newest revision waits while a splice is under way', () => {
  const to = (rotation: number) => (now: Edit[]) => [...now.filter((edit) => !isLight(edit)), turned(rotation)];
  for (const rotation of [1, 2, 3]) reviseEdits(to(rotation), 'film');
  expect(sent).toHaveLength(1);
  receiveLog(logWith(2, 1));
  receiveAccepted(1, 2);
  expect(sent.slice(1)).toEqual([['splice', 2, 0, 1, [turned(3)], 'film']]);
  expect(edits.value).toEqual([turned(3)]);
});

it('what waits for a splice is in force on this page, and what comes after it is made of it', () => {
  const put = (rotation: number) => reviseEdits((now) => [...now, turned(rotation)]);
  for (const rotation of [30, 40]) put(rotation);
  expect(edits.value).toEqual([10, 20, 30, 40].map(turned));
  reviseEdits((now) => now.filter((_, place) => place !== 0)); // of the log that will be: 40 stays in it
  receiveLog(logWith(2, 10, 20, 30));
  receiveAccepted(1, 2);
  expect(sent[1]).toEqual(['splice', 2, 3, 0, [turned(40)], null]);
  expect(edits.value).toEqual([20, 30, 40].map(turned));
  expect(editsToRestore()).toEqual(edits.value);
  receiveLog(logWith(3, 10, 20, 30, 40));
  receiveAccepted(2, 3);
  expect(sent[2]).toEqual(['splice', 3, 0, 1, [], null]);
  undo(); // what it takes back is the server's to say
  put(50);
  expect(edits.value).toEqual([20, 30, 40].map(turned));
});

it('what the user does during a splice comes after it', () => {
  reviseEdits(() => [turned(10)]);
  undo();
  goTo(0);
  expect(sent).toHaveLength(1);
  receiveLog(logWith(2, 10));
  receiveAccepted(1, 2);
  expect(sent.slice(1)).toEqual([['undo'], ['undo']]);
});

it('a place of the history is gone to once the edits on their way are in the log', () => {
  sendEdit(turned(30), null);
  goTo(2);
  expect(sent).toHaveLength(1);
  receiveAccepted(1, 2);
  expect(sent).toHaveLength(1); // accepted, but not yet in the log that this page has
  receiveLog(logWith(2, 10, 20, 30));
  expect(sent.slice(1)).toEqual([['undo']]);
});

it('a splice that another viewer was faster than is sent again, and given up after three times', () => {
  reviseEdits(() => [turned(10)]);
  for (let attempt = 1; attempt <= 3; attempt++) {
    receiveLog(logWith(1 + attempt, 10, 20));
    expect(receiveRejected(attempt, true)).toBe(false);
    expect(sent[attempt]).toEqual(['splice', 1 + attempt, 1, 1, [], null]);
  }
  expect(receiveRejected(4, true)).toBe(true);
  expect(edits.value).toEqual([10, 20].map(turned));
});

it('a draft is shown at once and sent when it is committed', () => {
  draftEdit(turned(25), isLight);
  draftEdit(turned(26), isLight);
  expect(edits.value).toEqual([10, 26].map(turned));
  expect(sent).toEqual([]);
  commitDraft();
  expect(sent).toEqual([['splice', 1, 1, 1, [turned(26)], null]]);
  receiveLog(logWith(2, 10, 26));
  receiveAccepted(1, 2);
  expect(draft.value).toBe(null);
});

it('a change of the log is made to the log that it was made to, and to no other', () => {
  const message = { type: 'change' as const, before: 'a', digest: 'b', revision: 3, can_undo: true, can_redo: true, appended: 1, edits: { start: 1, remove: 1, edits: [turned(5), turned(6)] }, undone: { start: 0, remove: 0, edits: [turned(20)] } };
  expect(receiveChange(message)).toBe(false);
  expect(log.value.revision).toBe(1);
  receiveLog({ ...logWith(2, 10, 20, 30), digest: 'a' });
  expect(receiveChange(message)).toBe(true);
  expect(log.value).toEqual({ revision: 3, digest: 'b', can_undo: true, can_redo: true, appended: 1, edits: [10, 5, 6, 30].map(turned), undone: [turned(20)] });
});

it('an edit that the server skips is known by its place and left out of what pictures are asked for with', () => {
  receiveLog({ ...logWith(2, 10, 20, 30), broken: [{ index: 1, reason: 'Its file is gone.' }] });
  expect(broken.value.get(1)).toBe('Its file is gone.');
  expect(appliedEdits()).toEqual([10, 30].map(turned));
  expect(edits.value).toHaveLength(3);
});

it('painted weights go up as a file before the edit that refers to it, and once', async () => {
  const vertex_weights = new Array<number>(30_000).fill(0.5);
  const painted = (roughness: number): Edit => ({ op: 'material', select: { vertex_weights }, set: { roughness }, mode: 'absolute' });
  const uploads: number[] = [];
  vi.stubGlobal('fetch', async (_: string, { body }: { body: Float32Array }) => {
    uploads.push(body.length);
    return { ok: true, json: async () => ({ file: 'weights/a.f32', vertices: body.length }) };
  });
  reviseEdits(() => [turned(10), turned(20), painted(0.1)]);
  expect(sent).toEqual([]);
  await vi.waitUntil(() => sent.length);
  const stored = (roughness: number): Edit => ({ op: 'material', select: { weights_file: 'weights/a.f32' }, set: { roughness }, mode: 'absolute' });
  expect(sent).toEqual([['splice', 1, 2, 0, [stored(0.1)], null]]);
  receiveLog({ ...logWith(2, 10, 20), edits: [turned(10), turned(20), stored(0.1)] });
  receiveAccepted(1, 2);
  sent = [];
  reviseEdits(() => [turned(10), turned(20), painted(0.1)]);
  expect(draft.value).toBe(null); // it is what the log holds
  reviseEdits(() => [turned(10), turned(20), painted(0.9)]);
  await vi.waitUntil(() => sent.length);
  expect(sent).toEqual([['splice', 2, 2, 1, [stored(0.9)], null]]);
  expect(uploads).toEqual([30_000]);
  vi.unstubAllGlobals();
});
