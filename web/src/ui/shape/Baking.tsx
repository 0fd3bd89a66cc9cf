/** Simulations of the open asset that a worker computes now. */

import { baking, clipOf, playClip } from '../../edit/shape/simulation';
import { cancel } from '../../session/jobs';
import { Bar } from '../fields';
import { duration } from '../library/Jobs';

export function Baking() {
  if (baking.value.length === 0) return null;
  return (
    <ul class="files" aria-label="Being computed">
      {baking.value.map((job) => {
        const left = job.eta_seconds === null ? '' : ` · ${duration(job.eta_seconds)} left`;
        return (
          <li key={job.id} class="baking">
            <Bar label={`Progress of ${job.name}`} share={job.fraction} />
            <span class="facts">{job.state === 'running' ? `${job.name}: ${job.message || 'begins'}${left}` : `${job.name}: waits for a worker`}</span>
            {job.state === 'running' && job.fraction > 0 && (
              <button title="What is made so far; the film goes on as more is" onClick={() => playClip(clipOf(job))}>
                Play
              </button>
            )}
            <button class="ghost" aria-label={`Cancel ${job.name}`} onClick={() => void cancel(job)}>
              Cancel
            </button>
          </li>
        );
      })}
    </ul>
  );
}
