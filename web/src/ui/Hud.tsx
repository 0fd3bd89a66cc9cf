/** What the picture is right now: samples, size, speed, and whether the server is there. */

import { playing } from '../edit/shape/simulation';
import { computing } from '../session/long_change';
import { cancelChange, connection, session, settings, status } from '../session/session';
import { entryOf } from '../stage/channels';

const PHASE_TEXT = { loading: 'Loading the asset…', moving: 'Moving', still: 'Refining', converged: 'Converged', paused: 'Paused' };

/** A film would ask for the same moment again. */
function giveUp(): void {
  playing.value = false;
  cancelChange();
}

export function Hud() {
  if (!session.value) return null;
  const now = status.value;
  const link = connection.value;
  const state = link === 'lost' || (link === 'connecting' && now) ? 'Reconnecting…' : link === 'connecting' ? 'Opening…' : link === 'closed' ? 'Disconnected' : now ? PHASE_TEXT[now.phase] : 'Loading the asset…';
  const kind = link !== 'open' ? 'away' : now?.phase === 'converged' ? 'done' : 'busy';
  const scale = now && now.scale < 0.995 ? ` (${Math.round(100 * now.scale)} %)` : '';
  return (
    <section class="hud" aria-label="State of the picture" data-state={link === 'open' ? (now?.phase ?? 'loading') : link}>
      <span class={`lamp ${kind}`} aria-hidden="true" />
      <span role="status">{link === 'open' && computing.value ? 'Computing the change…' : state}</span>
      {link === 'open' && computing.value && (
        <button class="ghost" title="Give up the change; everything stays as it was" onClick={giveUp}>
          Cancel
        </button>
      )}
      {now && now.width > 0 && link === 'open' && (
        <>
          {entryOf(settings.value.channel).lit && (
            <span class="hud-samples">
              Sample {now.spp}/{now.spp_target}
            </span>
          )}
          <span class="hud-size">
            {now.width}×{now.height}
            {scale}
          </span>
          <span>{now.frames_per_second.toFixed(now.frames_per_second < 10 ? 1 : 0)} fps</span>
          <span class="hud-cost">{now.render_ms.toFixed(0)} ms</span>
          {now.notes.length > 0 && (
            <span class="hud-notes" title={now.notes.join('\n')}>
              {now.notes.length === 1 ? now.notes[0] : `${now.notes.length} skips`}
            </span>
          )}
        </>
      )}
      {now && link === 'open' && now.phase !== 'converged' && entryOf(settings.value.channel).lit && (
        <div class="hud-bar" aria-hidden="true">
          <div style={{ width: `${(100 * now.spp) / Math.max(1, now.spp_target)}%` }} />
        </div>
      )}
    </section>
  );
}
