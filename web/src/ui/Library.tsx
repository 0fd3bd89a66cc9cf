/** Left-hand panel: builds under way or past, and the assets that can be opened. */

import { signal } from '@preact/signals';
import { useEffect, useRef, useState } from 'preact/hooks';
import * as api from '../api';
import { buildSample, cancel, isActive, remove, resume, retry, takeFile, type Preset } from '../jobs';
import type { JobFile, JobInfo } from '../protocol.gen';
import { openAsset } from '../session';
import { assets, attempt, jobs, libraryOpen, psnrCurves, session, workersAlive } from '../state';
import { Choice, Section } from './fields';
import { Icon } from './icons';

export const preset = signal<Preset>('fast');
/** Share of the upload under way; null while there is none. */
export const uploading = signal<{ name: string; share: number } | null>(null);

export async function takeFiles(files: Iterable<File>): Promise<void> {
  for (const file of files) {
    uploading.value = { name: file.name, share: 0 };
    await takeFile(file, preset.value, (share) => (uploading.value = { name: file.name, share }));
    uploading.value = null;
  }
}

export function Library() {
  if (!libraryOpen.value) return null;
  return (
    <aside class="panel library" aria-label="Library">
      <NewBuild />
      <Jobs />
      <Assets />
    </aside>
  );
}

export function NewBuild() {
  const file = useRef<HTMLInputElement>(null);
  return (
    <Section title="New asset">
      <Choice
        label="Quality"
        value={preset.value}
        options={[
          { value: 'draft', text: 'Draft', title: 'About a minute: to see whether the capture works' },
          { value: 'fast', text: 'Fast', title: 'Some minutes' },
          { value: 'full', text: 'Full', title: 'Up to an hour: the best this capture gives' },
        ]}
        onChange={(value) => (preset.value = value)}
      />
      <div class="buttons">
        <button class="primary" onClick={() => void buildSample(preset.value)}>
          Build the sample
        </button>
        <button onClick={() => file.current?.click()}>Choose a file…</button>
      </div>
      <input
        ref={file}
        class="visually-hidden"
        type="file"
        accept=".zip,.glb,.obj,.ply"
        tabIndex={-1}
        aria-label="Capture or mesh"
        onChange={(event) => {
          const chosen = [...(event.currentTarget.files ?? [])];
          event.currentTarget.value = '';
          void takeFiles(chosen);
        }}
      />
      <p class="hint">Or drop a capture (.zip of posed photos), a mesh (.glb, .obj, .ply) or a light (.exr, .hdr) anywhere on this page.</p>
      {uploading.value && <Upload {...uploading.value} />}
    </Section>
  );
}

function Upload({ name, share }: { name: string; share: number }) {
  const label = share < 1 ? `Uploading ${name}` : `The server is reading ${name}…`;
  return (
    <div role="status">
      <p class="facts">{label}</p>
      <Bar label={label} share={share} />
    </div>
  );
}

export function Bar({ label, share }: { label: string; share: number }) {
  const percent = Math.round(100 * share);
  return (
    <div class="bar" role="progressbar" aria-label={label} aria-valuenow={percent} aria-valuemin={0} aria-valuemax={100}>
      <div style={{ width: `${percent}%` }} />
    </div>
  );
}

function Jobs() {
  const list = jobs.value;
  if (list.length === 0) return null;
  return (
    <Section title="Jobs">
      {workersAlive.value === 0 && list.some(isActive) && <p class="warning">No worker is running, so jobs wait. Start one with `drgs worker`.</p>}
      <ul class="jobs">
        {list.slice(0, 12).map((job) => (
          <Job key={job.id} job={job} />
        ))}
      </ul>
    </Section>
  );
}

const STATE_TEXT: Record<JobInfo['state'], string> = {
  queued: 'Waiting for a worker',
  running: 'Running',
  stalled: 'Its worker stopped; another will take it over',
  done: 'Done',
  failed: 'Failed',
  cancelled: 'Cancelled',
  unknown: 'Lost: the queue no longer knows it',
};

export function duration(seconds: number): string {
  const whole = Math.max(0, Math.round(seconds));
  if (whole < 60) return `${whole} s`;
  const minutes = Math.round(whole / 60);
  return minutes < 90 ? `${minutes} min` : `${(whole / 3600).toFixed(1)} h`;
}

const KIND_TEXT: Record<JobInfo['kind'], string> = { build: 'Build', redecouple: 'Materials again', simulate: 'Simulation', render: 'Pictures', export: 'Files' };

function Job({ job }: { job: JobInfo }) {
  const active = isActive(job);
  const stage = job.stage ? job.stage.replace(/_/g, ' ') : STATE_TEXT[job.state];
  const facts = [
    job.iterations > 0 && `${job.iteration} of ${job.iterations}`,
    job.psnr !== null && `${job.psnr.toFixed(1)} dB`,
    job.eta_seconds !== null && `${duration(job.eta_seconds)} left`,
    job.attempts > 1 && `attempt ${job.attempts}`,
  ].filter(Boolean);
  const again = job.state === 'failed' || job.state === 'cancelled' || job.state === 'unknown';
  return (
    <li class={`job ${job.state}`} aria-label={`${KIND_TEXT[job.kind]} ${job.name}: ${STATE_TEXT[job.state]}`}>
      {active && job.preview_version > 0 && <img class="preview" src={api.jobPreview(job)} alt={`Preview of ${job.name}`} />}
      <div class="job-head">
        <strong>{job.name}</strong>
        <span class="tag">{job.kind === 'build' ? job.preset : KIND_TEXT[job.kind]}</span>
        <span class={`state ${job.state}`}>{active && job.state === 'running' ? stage : STATE_TEXT[job.state]}</span>
      </div>
      {active && <Bar label={`Progress of ${job.name}`} share={job.fraction} />}
      {active && <PsnrCurve curve={psnrCurves.value[job.id] ?? []} />}
      {active && <p class="facts">{facts.join(' · ') || job.message}</p>}
      {active && job.message && facts.length > 0 && <p class="facts">{job.message}</p>}
      {job.error && <p class="warning">{job.error}</p>}
      {job.state === 'done' && (job.kind === 'render' || job.kind === 'export') && <JobFiles job={job} />}
      <div class="buttons">
        {active && <button onClick={() => void cancel(job)}>Cancel</button>}
        {job.state === 'stalled' && <button onClick={() => void resume(job)}>Resume</button>}
        {again && <button onClick={() => void retry(job)}>Retry</button>}
        {job.state === 'done' && job.asset_id && job.asset_id !== session.value?.asset && <button onClick={() => void openAsset(job.asset_id!)}>Open</button>}
        {!active && <button onClick={() => void remove(job)}>Remove</button>}
      </div>
    </li>
  );
}

/** Quality against progress; nothing until there are two points. */
function PsnrCurve({ curve }: { curve: [number, number][] }) {
  if (curve.length < 2) return null;
  const values = curve.map(([, psnr]) => psnr);
  const low = Math.min(...values);
  const span = Math.max(1, Math.max(...values) - low);
  const points = curve.map(([share, psnr]) => `${(100 * share).toFixed(1)},${(28 - (26 * (psnr - low)) / span).toFixed(1)}`).join(' ');
  return (
    <svg class="curve" viewBox="0 0 100 30" preserveAspectRatio="none" role="img" aria-label={`Quality from ${values[0]!.toFixed(1)} to ${values.at(-1)!.toFixed(1)} dB`}>
      <polyline points={points} />
    </svg>
  );
}

const MANY_FILES = 6;

function JobFiles({ job }: { job: JobInfo }) {
  const [files, setFiles] = useState<JobFile[] | null>(null);
  useEffect(() => {
    void attempt(api.jobFiles(job.id)).then((list) => {
      // A film matters more than its pictures.
      if (list) setFiles(list.files.toSorted((a, b) => Number(b.media_type.startsWith('video')) - Number(a.media_type.startsWith('video'))));
    });
  }, [job.id]);
  if (!files) return null;
  return (
    <ul class="files">
      {files.slice(0, MANY_FILES).map((file) => (
        <li>
          <a class="button" href={api.jobFile(job.id, file.name)} download={file.name}>
            <Icon name="download" /> {file.name}
          </a>
        </li>
      ))}
      {files.length > MANY_FILES && <li class="facts">and {files.length - MANY_FILES} more, by the API</li>}
    </ul>
  );
}

function Assets() {
  const list = assets.value;
  return (
    <Section title="Assets">
      {list === null ? (
        <p class="hint">Asking the server…</p>
      ) : list.length === 0 ? (
        <p class="hint">None yet. Build the sample to get one.</p>
      ) : (
        <ul class="assets">
          {list.map((asset) => (
            <li key={asset.id}>
              <button class="asset" aria-current={asset.id === session.value?.asset ? 'true' : undefined} onClick={() => void openAsset(asset.id)}>
                {asset.has_thumbnail ? <img src={api.assetThumb(asset)} alt="" loading="lazy" /> : <span class="no-thumb" aria-hidden="true"><Icon name="frame" /></span>}
                <span class="asset-text">
                  <strong>{asset.name}</strong>
                  <span>{asset.version > 1 ? `version ${asset.version} · ` : ''}{asset.surfel_count > 0 ? `${asset.surfel_count.toLocaleString()} surfels` : `${asset.face_count.toLocaleString()} faces`}</span>
                </span>
              </button>
            </li>
          ))}
        </ul>
      )}
    </Section>
  );
}
