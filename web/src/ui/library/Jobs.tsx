/** Jobs under way and past: what a build makes of its capture, seen while it does, and what came of it. */

import { useEffect, useState } from 'preact/hooks';
import * as api from '../../session/api';
import { captures, openCapture } from '../../session/captures';
import { cancel, isActive, jobs, psnrCurves, remove, resume, retry, STATE_TEXT, workersAlive } from '../../session/jobs';
import { attempt } from '../../session/notices';
import type { JobFile, JobInfo } from '../../session/protocol.gen';
import { openAsset, session } from '../../session/session';
import { Bar, Section } from '../fields';
import { Icon } from '../icons';
import { Findings, isUnreadable } from './Findings';

export function Jobs() {
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

export function duration(seconds: number): string {
  const whole = Math.max(0, Math.round(seconds));
  if (whole < 60) return `${whole} s`;
  const minutes = Math.round(whole / 60);
  return minutes < 90 ? `${minutes} min` : `${(whole / 3600).toFixed(1)} h`;
}

const KIND_TEXT: Record<JobInfo['kind'], string> = { build: 'Build', pose: 'Poses', redecouple: 'Materials again', simulate: 'Simulation', render: 'Pictures', export: 'Files' };

function Job({ job }: { job: JobInfo }) {
  const active = isActive(job);
  const stage = job.stage ? job.stage.replace(/_/g, ' ') : STATE_TEXT[job.state];
  const facts = [
    job.iterations > 0 && `${job.iteration} of ${job.iterations}`,
    job.psnr !== null && `${job.psnr.toFixed(1)} dB`,
    job.eta_seconds !== null && `${duration(job.eta_seconds)} left`,
    job.attempts > 1 && `attempt ${job.attempts}`,
  ].filter(Boolean);
  const made = captures.value.find((capture) => capture.id === job.capture_id);
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
      {job.capture && <Findings report={job.capture} said={job.error} open={active || job.state === 'failed'} />}
      {job.state === 'failed' && isUnreadable(job.capture) && <p class="hint">Then drop the mended folder here. “Retry” reads the same pictures again.</p>}
      {job.state === 'done' && (job.kind === 'render' || job.kind === 'export') && <JobFiles job={job} />}
      <div class="buttons">
        {active && <button onClick={() => void cancel(job)}>Cancel</button>}
        {job.state === 'stalled' && <button onClick={() => void resume(job)}>Resume</button>}
        {again && <button onClick={() => void retry(job)}>Retry</button>}
        {job.state === 'done' && job.asset_id && job.asset_id !== session.value?.asset && <button onClick={() => void openAsset(job.asset_id!)}>Open</button>}
        {made && <button onClick={() => void openCapture(made)}>Look</button>}
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
