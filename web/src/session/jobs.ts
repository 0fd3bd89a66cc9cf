/** Jobs of the server's workers: started here, and kept up to date by asking. */

import { signal } from '@preact/signals';
import * as api from './api';
import { capture, openCapture, refreshCaptures } from './captures';
import { refreshAssets, refreshEnvironments } from './library';
import { attempt, notify } from './notices';
import { preference } from './preferences';
import type { BoxCorners, BuildRequest, CaptureInfo, JobInfo, RenderRequest, SimulateRequest, Stroke } from './protocol.gen';
import { openAsset, session } from './session';
import type { Vec3 } from './view';

/** Jobs are asked for this often while one runs, and otherwise. */
const BUSY_MS = 1000;
const IDLE_MS = 6000;
/** Points that a curve of quality keeps. */
const LONGEST_CURVE = 400;

export const jobs = signal<JobInfo[]>([]);
export const workersAlive = signal(1);
/** (share of the job, PSNR [dB]) by job, as far as this browser saw it. */
export const psnrCurves = preference<Record<string, [number, number][]>>('psnr', {});

export const isActive = (job: JobInfo) => job.state === 'queued' || job.state === 'running' || job.state === 'stalled';

export const STATE_TEXT: Record<JobInfo['state'], string> = {
  queued: 'Waiting for a worker',
  running: 'Running',
  stalled: 'Its worker stopped; another will take it over',
  done: 'Done',
  failed: 'Failed',
  cancelled: 'Cancelled',
  unknown: 'Lost: the queue no longer knows it',
};

/** Builds started from this page open their asset when it is ready. */
const toOpen = new Set<string>();

async function refreshJobs(): Promise<void> {
  const list = await api.listJobs();
  const before = new Map(jobs.value.map((job) => [job.id, job.state]));
  jobs.value = list.jobs;
  workersAlive.value = list.workers_alive;
  recordPsnr(list.jobs);
  for (const job of list.jobs) {
    const earlier = before.get(job.id);
    if (earlier === undefined || earlier === job.state) continue;
    if (job.state === 'done') await finished(job);
    if (job.state === 'failed') notify(`“${job.name}” failed: ${job.error ?? 'the server gave no reason.'}`);
  }
}

/** Add the newest points to the curves; curves of jobs that are gone go too. */
function recordPsnr(list: JobInfo[]): void {
  const known = psnrCurves.value;
  const next: typeof known = {};
  let changed = false;
  for (const job of list) {
    const curve = known[job.id] ?? [];
    const newest = curve.at(-1);
    const fresh = job.psnr !== null && isActive(job) && (!newest || newest[0] !== job.fraction);
    if (fresh || curve.length) next[job.id] = fresh ? [...curve, [job.fraction, job.psnr!] as [number, number]].slice(-LONGEST_CURVE) : curve;
    changed ||= fresh;
  }
  if (changed || Object.keys(known).length !== Object.keys(next).length) psnrCurves.value = next;
}

async function finished(job: JobInfo): Promise<void> {
  if (job.capture_id) return posed(job, job.capture_id);
  if (!job.asset_id) return notify(job.kind === 'simulate' ? `“${job.name}” is simulated: play it under Shape.` : `“${job.name}” is done: its files are in the list.`, 'info');
  await refreshAssets();
  const wanted = toOpen.delete(job.id);
  if (job.asset_id && (wanted || !session.value)) await openAsset(job.asset_id);
  else notify(`“${job.name}” is built: find it under Assets.`, 'info');
}

/** Whoever looks at the photographs is shown the capture that has their poses. */
async function posed(job: JobInfo, made: string): Promise<void> {
  await refreshCaptures();
  if (capture.value?.jobs.includes(job.id)) void openCapture(await api.readCapture(made));
  else notify(`The poses of “${job.name}” are found: look at them under Captures.`, 'info');
}

/** Ask for jobs for as long as the page lives: often while one runs, seldom otherwise, not at all while hidden. */
export function watchJobs(): void {
  let failing = false;
  const step = async () => {
    if (!document.hidden) {
      try {
        await refreshJobs();
        if (failing) await Promise.all([refreshAssets(), refreshEnvironments()]);
        failing = false;
      } catch (error) {
        // Said once; the stream's own "reconnecting" sign stays on while the server is away.
        if (!failing) notify((error as Error).message);
        failing = true;
      }
    }
    setTimeout(step, failing || jobs.value.some(isActive) ? BUSY_MS : IDLE_MS);
  };
  void step();
}

/** List a job that was just started, and open what it makes. */
async function follow(started: Promise<JobInfo>): Promise<JobInfo | null> {
  const job = await attempt(started);
  if (!job) return null;
  toOpen.add(job.id);
  jobs.value = [job, ...jobs.value.filter((other) => other.id !== job.id)];
  void attempt(refreshJobs());
  return job;
}

/** How a capture becomes an asset. */
export type BuildChoice = Required<Pick<BuildRequest, 'preset' | 'binding' | 'light' | 'masks' | 'cameras'>>;

export const buildSample = (choice: BuildChoice) => follow(api.startJob({ dataset: 'sample', ...choice }));
/** `up`: direction of the capture's world that points up. `box`: of the world that is turned so; null: all of the object. `strokes`: null: the capture's own masks count. */
export const buildCapture = (capture: CaptureInfo, choice: BuildChoice, up: Vec3, box: BoxCorners | null, strokes: Stroke[] | null) =>
  follow(api.startJob({ dataset: `capture:${capture.id}`, ...choice, up, box, strokes }));
/** Look for the poses of a capture's photographs; the capture then knows of the job. */
export async function findPoses(photographs: CaptureInfo): Promise<void> {
  const job = await follow(api.startJob({ kind: 'pose', dataset: `capture:${photographs.id}` }));
  if (job && capture.value?.id === photographs.id) capture.value = await api.readCapture(photographs.id);
  await attempt(refreshCaptures());
}
/** What to call a job on an asset. Those of earlier versions may have slashes in their names, which names no longer have. */
export const jobName = (asset: string, what: string) => `${asset.replaceAll(/[/\\]/g, '-').slice(0, 100 - what.length - 2)}, ${what}`;
/** A job that makes no asset. */
export const startJob = (request: RenderRequest | SimulateRequest) => follow(api.startJob(request));
export const resume = (job: JobInfo) => follow(api.resumeJob(job.id));
export const retry = (job: JobInfo) => follow(api.retryJob(job.id));

export async function cancel(job: JobInfo): Promise<void> {
  await attempt(api.cancelJob(job.id));
  await attempt(refreshJobs());
}

export async function remove(job: JobInfo): Promise<void> {
  await attempt(api.deleteJob(job.id));
  await attempt(refreshJobs());
}
