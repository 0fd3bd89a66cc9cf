/** Builds, assets and environments: what the server holds, kept up to date by asking. */

import * as api from './api';
import type { AssetInfo, BuildRequest, JobInfo, RenderRequest, SimulateRequest } from './protocol.gen';
import { editLight, openAsset } from './session';
import { assets, attempt, environments, jobs, notify, psnrCurves, session, workersAlive } from './state';
import { holdsAsset } from './zip';

const BUSY_MS = 1000;
const IDLE_MS = 6000;

export const isActive = (job: JobInfo) => job.state === 'queued' || job.state === 'running' || job.state === 'stalled';

/** Builds started from this page open their asset when it is ready, unless the user has opened another meanwhile. */
const toOpen = new Set<string>();

export async function refreshJobs(): Promise<void> {
  const list = await api.listJobs();
  const before = new Map(jobs.value.map((job) => [job.id, job.state]));
  jobs.value = list.jobs;
  workersAlive.value = list.workers_alive;
  followPsnr(list.jobs);
  for (const job of list.jobs) {
    const earlier = before.get(job.id);
    if (earlier === undefined || earlier === job.state) continue;
    if (job.state === 'done') await finished(job);
    if (job.state === 'failed') notify(`“${job.name}” failed: ${job.error ?? 'the server gave no reason.'}`);
  }
}

/** The curve is what this browser saw; it keeps it over a reload, and forgets jobs that are gone. */
function followPsnr(list: JobInfo[]): void {
  const known = psnrCurves.value;
  const next: typeof known = {};
  let changed = false;
  for (const job of list) {
    const curve = known[job.id] ?? [];
    const newest = curve.at(-1);
    const fresh = job.psnr !== null && isActive(job) && (!newest || newest[0] !== job.fraction);
    if (fresh || curve.length) next[job.id] = fresh ? [...curve, [job.fraction, job.psnr!] as [number, number]].slice(-400) : curve;
    changed ||= fresh;
  }
  if (changed || Object.keys(known).length !== Object.keys(next).length) psnrCurves.value = next;
}

async function finished(job: JobInfo): Promise<void> {
  if (!job.asset_id) return notify(job.kind === 'simulate' ? `“${job.name}” is simulated: play it under Shape.` : `“${job.name}” is done: its files are in the list.`, 'info');
  await refreshAssets();
  const wanted = toOpen.delete(job.id);
  if (job.asset_id && (wanted || !session.value)) await openAsset(job.asset_id);
  else notify(`“${job.name}” is built: find it under Assets.`, 'info');
}

export async function refreshAssets(): Promise<void> {
  assets.value = (await api.listAssets()).assets;
}

export async function refreshEnvironments(): Promise<void> {
  environments.value = (await api.listEnvironments()).environments;
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

async function follow(started: Promise<JobInfo>): Promise<JobInfo | null> {
  const job = await attempt(started);
  if (!job) return null;
  toOpen.add(job.id);
  jobs.value = [job, ...jobs.value.filter((other) => other.id !== job.id)];
  void attempt(refreshJobs());
  return job;
}

export const buildSample = (choice: BuildChoice) => follow(api.startJob({ dataset: 'sample', ...choice }));
/** Jobs that make no asset: the list shows them. */
export const startJob = (request: RenderRequest | SimulateRequest) => follow(api.startJob(request));
export const resume = (job: JobInfo) => follow(api.resumeJob(job.id));
export const retry = (job: JobInfo) => follow(api.retryJob(job.id));
/** How a capture becomes an asset. */
export type BuildChoice = Required<Pick<BuildRequest, 'preset' | 'binding'>>;

export async function cancel(job: JobInfo): Promise<void> {
  await attempt(api.cancelJob(job.id));
  await attempt(refreshJobs());
}

export async function remove(job: JobInfo): Promise<void> {
  await attempt(api.deleteJob(job.id));
  await attempt(refreshJobs());
}

/** Take a dropped or chosen file by what its name says it is; returns what was made of it. */
export async function takeFile(file: File, choice: BuildChoice, onProgress: (share: number) => void): Promise<'environment' | 'asset' | 'build' | null> {
  const name = file.name.toLowerCase();
  if (/\.(exr|hdr)$/.test(name)) {
    const added = await attempt(api.uploadEnvironment(file, onProgress));
    if (!added) return null;
    await attempt(refreshEnvironments());
    editLight({ file: added.name });
    return 'environment';
  }
  if (/\.(glb|obj|ply)$/.test(name) || (name.endsWith('.zip') && (await holdsAsset(file)))) {
    const added: AssetInfo | null = await attempt(api.uploadAsset(file, onProgress));
    if (!added) return null;
    await attempt(refreshAssets());
    await openAsset(added.id);
    return 'asset';
  }
  if (name.endsWith('.zip')) {
    await follow(api.uploadCapture(file, choice, onProgress));
    return 'build';
  }
  notify(`“${file.name}” is none of the kinds that can be dropped here: a capture (.zip), a mesh (.glb, .obj, .ply) or a light (.exr, .hdr).`);
  return null;
}
