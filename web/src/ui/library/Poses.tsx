/** Of photographs without cameras: their poses can be looked for before the build, which would do it as its first step. */

import { useState } from 'preact/hooks';
import { captures, openCapture } from '../../session/captures';
import { cancel, findPoses, isActive, jobs, STATE_TEXT, workersAlive } from '../../session/jobs';
import type { CaptureInfo, JobInfo } from '../../session/protocol.gen';
import { Bar } from '../fields';

/** The newest search for the poses of a capture. */
export const searchOf = (info: CaptureInfo): JobInfo | undefined => jobs.value.find((job) => job.kind === 'pose' && info.jobs.includes(job.id));

export function Poses({ info }: { info: CaptureInfo }) {
  const [busy, setBusy] = useState(false);
  const search = searchOf(info);
  const start = async () => {
    setBusy(true);
    await findPoses(info);
    setBusy(false);
  };
  const found = search?.state === 'done' && captures.value.find((other) => other.id === search.capture_id);
  return (
    <div class="capture-picture poses">
      {search && isActive(search) ? (
        <>
          <p role="status">{search.state === 'running' ? search.message || 'Looking for poses' : STATE_TEXT[search.state]}</p>
          <Bar label={`Search for the poses of ${info.name}`} share={search.fraction} />
          {workersAlive.value === 0 && <p class="warning">No worker is running, so jobs wait. Start one with `drgs worker`.</p>}
          <p class="hint">It goes on when this is closed: the list of jobs shows it.</p>
          <button type="button" onClick={() => void cancel(search)}>
            Cancel
          </button>
        </>
      ) : found ? (
        <>
          <p>Where the pictures were taken from has been found.</p>
          <button type="button" class="primary" onClick={() => void openCapture(found)}>
            Look at {found.name}
          </button>
        </>
      ) : (
        <>
          <p>Where the pictures were taken from is not known yet.</p>
          {search?.error && <p class="warning">{search.error}</p>}
          <p class="hint">Found now, cameras, points and the box can be looked at and changed before the build. Otherwise the build begins with it.</p>
          <button type="button" class="primary" disabled={busy} onClick={() => void start()}>
            Find poses
          </button>
        </>
      )}
    </div>
  );
}
