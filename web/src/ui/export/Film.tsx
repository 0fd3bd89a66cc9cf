/** Moving pictures as MP4: the camera on its way through chosen views, or once round the object. Both are jobs. */

import { signal } from '@preact/signals';
import { jobName, startJob } from '../../session/jobs';
import { appliedEdits } from '../../session/edit_log';
import { notify } from '../../session/notices';
import type { RenderRequest } from '../../session/protocol.gen';
import { stillBounces } from '../../session/api';
import { session, settings } from '../../session/session';
import { aimNow } from '../../session/view';
import { asTransforms, pathFrames } from '../../stage/camera/camera_path';
import { addView, closeFilm, filmClosed, filmPlaying, filmSeconds, filmTime, filmViews, LEAST_SECONDS, MOST_SECONDS, moveView, playFilm, removeView, seekFilm, setViewSeconds, showView, stopFilm, type FilmView } from '../../stage/camera/film';
import { download } from '../download';
import { Choice, NumberField, Section, Slider, Switch } from '../fields';
import { Icon } from '../icons';
import { libraryOpen } from '../layout';

const FPS = 24;
const TURNTABLE_FRAMES = 72;
const SIZES = { small: { width: 640, height: 360 }, hd: { width: 1280, height: 720 }, full: { width: 1920, height: 1080 } };
const size = signal<keyof typeof SIZES>('hd');
/** Samples a pixel. */
const quality = signal<'16' | '64' | '256'>('64');

/** With the session's edits, as a job whose film is in the list of jobs. */
async function renderFilm(what: string, way: Pick<RenderRequest, 'turntable' | 'path'>): Promise<void> {
  const open = session.value!;
  libraryOpen.value = true;
  await startJob({
    kind: 'render',
    asset: open.asset,
    name: jobName(open.assetName, what),
    ...way,
    variants: [{ name: 'edited', edits: appliedEdits() }],
    video_fps: FPS,
    ...SIZES[size.value],
    spp: Number(quality.value),
    bounces: stillBounces(settings.value),
    exposure_stops: settings.value.exposure_stops,
    tone_curve: settings.value.tone_curve,
    background: Array.isArray(settings.value.background) ? 'transparent' : settings.value.background,
  });
}

const keyframes = () => filmViews.value.map(({ eye, target, fov_y_degrees, seconds }) => ({ eye, target, fov_y_degrees, seconds }));

function saveCameras(): void {
  const cameras = asTransforms(keyframes(), FPS, SIZES[size.value], filmClosed.value);
  download(new Blob([cameras], { type: 'application/json' }), 'transforms.json');
  notify('These cameras are what `drgs render --cameras` takes.', 'info');
}

export function Film() {
  const views = filmViews.value;
  const ready = views.length > 1;
  return (
    <Section title="Film">
      {views.length > 0 && (
        <ol class="views" aria-label="Views of the film">
          {views.map((view, index) => (
            <ViewRow key={view.id} view={view} index={index} count={views.length} />
          ))}
        </ol>
      )}
      <div class="buttons">
        <button disabled={!aimNow.value} onClick={addView}>
          <Icon name="plus" /> Add this view
        </button>
        {ready && (
          <button onClick={() => (filmPlaying.value ? stopFilm() : playFilm())}>
            <Icon name={filmPlaying.value ? 'stop' : 'play'} /> {filmPlaying.value ? 'Stop' : 'Preview'}
          </button>
        )}
      </div>
      {ready && <Switch label="Closed path" title="From the last view back to the first without resting there: a film to show over and over" value={filmClosed.value} onChange={closeFilm} />}
      {ready && (
        <Slider
          label="Moment"
          unit="s"
          value={filmTime.value}
          min={0}
          max={filmSeconds.value}
          step={0.01}
          onChange={(time) => {
            stopFilm();
            seekFilm(time);
          }}
        />
      )}
      <Choice
        label="Film size"
        value={size.value}
        options={[
          { value: 'small', text: '360p', title: '640×360' },
          { value: 'hd', text: '720p', title: '1280×720' },
          { value: 'full', text: '1080p', title: '1920×1080' },
        ]}
        onChange={(value) => (size.value = value)}
      />
      <Choice
        label="Film quality"
        value={quality.value}
        options={[
          { value: '16', text: 'Draft', title: '16 samples a pixel' },
          { value: '64', text: 'Good', title: '64 samples a pixel' },
          { value: '256', text: 'Best', title: '256 samples a pixel' },
        ]}
        onChange={(value) => (quality.value = value)}
      />
      <div class="buttons">
        <button class="primary" disabled={!ready} title="The camera on its way through the views; a job" onClick={() => void renderFilm('film', { path: { keyframes: keyframes(), closed: filmClosed.value } })}>
          <Icon name="film" /> Render film (MP4)
        </button>
        <button title={`${TURNTABLE_FRAMES} pictures round the object, as MP4; a job`} onClick={() => void renderFilm('turntable', { turntable: { frames: TURNTABLE_FRAMES } })}>
          Turntable (MP4)
        </button>
        {ready && (
          <button title="The film’s cameras as transforms.json, for `drgs render`" onClick={saveCameras}>
            Save cameras
          </button>
        )}
      </div>
      <p class="hint">
        {ready
          ? `${pathFrames(views, FPS, filmClosed.value)} pictures, ${FPS} a second. The camera goes round what it looks at, and ${filmClosed.value ? 'comes back to where it began.' : 'rests at both ends.'}`
          : 'Add two views or more: the camera goes from one to the next. Film and turntable show the object with its edits.'}
      </p>
    </Section>
  );
}

function ViewRow({ view, index, count }: { view: FilmView; index: number; count: number }) {
  const name = `view ${index + 1}`;
  return (
    <li>
      <button class="name" title="Look from there" aria-label={`Go to ${name}`} onClick={() => showView(view)}>
        View {index + 1}
      </button>
      {index > 0 || (filmClosed.value && count > 1) ? (
        <NumberField bare label={`Seconds to ${name}`} title={`From view ${index > 0 ? index : count} to here`} unit="s" value={view.seconds} min={LEAST_SECONDS} max={MOST_SECONDS} step={0.1} onEnter={(seconds) => setViewSeconds(view.id, seconds)} />
      ) : (
        <span class="dim">Start</span>
      )}
      <button class="ghost" title="Earlier" aria-label={`Move ${name} earlier`} disabled={index === 0} onClick={() => moveView(view.id, -1)}>
        <Icon name="up" />
      </button>
      <button class="ghost" title="Later" aria-label={`Move ${name} later`} disabled={index === count - 1} onClick={() => moveView(view.id, 1)}>
        <Icon name="down" />
      </button>
      <button class="ghost" title="Remove" aria-label={`Remove ${name}`} onClick={() => removeView(view.id)}>
        <Icon name="close" />
      </button>
    </li>
  );
}
