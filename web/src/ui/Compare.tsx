/** Photograph, captured object and divider over the picture, and what the View page says of them. */

import * as api from '../session/api';
import { capturedStill } from '../capture/captured_still';
import { photographInSight, photographOpacity, photographPlace, showPhotographs, split, stepView, trainingViews, viewInSight, viewNumber } from '../capture/photographs';
import { session } from '../session/session';
import { freeEdges } from '../stage/camera/free_area';
import { Section, Slider, Switch } from './fields';
import { Icon } from './icons';
import { titleFor } from './shortcuts';

const STEP = 0.01;
const BIG_STEP = 0.1;
/** The divider can't be pushed out of the window. */
const EDGE = 0.02;

/** At first through the middle of what the panels leave free, where the object is. */
export function toggleSplit(): void {
  const { left, right } = freeEdges(window.innerWidth, window.innerHeight);
  split.value = split.value === null ? (left + right) / 2 / window.innerWidth : null;
}

/** The photograph where the camera shows the same; it takes no pointer. */
function Photograph() {
  const place = photographPlace.value;
  const asset = session.value?.asset;
  if (!asset || viewNumber.value === null || !photographInSight.value) return null;
  const right = split.value === null || !place ? 0 : place.left + place.width - split.value * window.innerWidth;
  return (
    <img
      class="photograph"
      src={api.photograph(asset, viewNumber.value)}
      alt={`Photograph ${viewInSight.value?.name ?? ''}`}
      data-shown={String(place !== null)}
      style={{
        ...(place && { left: `${place.left}px`, top: `${place.top}px`, width: `${place.width}px`, height: `${place.height}px` }),
        opacity: !place ? 0 : split.value === null ? photographOpacity.value / 100 : 1,
        clipPath: `inset(0 ${Math.max(0, right)}px 0 0)`,
      }}
    />
  );
}

/** Over the local picture of the same, once it is there. */
function CapturedStill() {
  const url = capturedStill.value;
  if (url === null || split.value === null) return null;
  return <img class="captured-still" src={url} alt="The object as captured" style={{ clipPath: `inset(0 ${100 * (1 - split.value)}% 0 0)` }} />;
}

function Divider() {
  const share = split.value;
  if (share === null || !session.value) return null;
  const put = (next: number) => (split.value = Math.min(1 - EDGE, Math.max(EDGE, next)));
  const onKey = (event: KeyboardEvent) => {
    const step = event.shiftKey ? BIG_STEP : STEP;
    const moves: Record<string, number> = { ArrowLeft: share - step, ArrowDown: share - step, ArrowRight: share + step, ArrowUp: share + step, PageDown: share - BIG_STEP, PageUp: share + BIG_STEP, Home: 0, End: 1 };
    const next = moves[event.key];
    if (next === undefined) return;
    event.preventDefault();
    event.stopPropagation();
    put(next);
  };
  const percent = Math.round(100 * share);
  const before = photographInSight.value ? 'Photograph' : 'As captured';
  return (
    <div
      class="divider"
      role="slider"
      tabIndex={0}
      aria-label="Split between before and now"
      aria-valuemin={0}
      aria-valuemax={100}
      aria-valuenow={percent}
      aria-valuetext={`${before} on the left ${percent} % of the window`}
      style={{ left: `${100 * share}%` }}
      onKeyDown={onKey}
      onPointerDown={(event) => event.button === 0 && event.currentTarget.setPointerCapture(event.pointerId)}
      onPointerMove={(event) => event.currentTarget.hasPointerCapture(event.pointerId) && put(event.clientX / window.innerWidth)}
    >
      <span class="divider-name before">{before}</span>
      <span class="divider-name now">Now</span>
    </div>
  );
}

function ViewBar() {
  const view = viewInSight.value;
  if (!view) return null;
  const what = photographInSight.value ? 'photograph' : 'view';
  return (
    <nav class="view-bar" aria-label="Views of the capture">
      <button class="ghost" aria-label={`Previous ${what}`} title={titleFor('previousView')} onClick={() => stepView(-1)}>
        <Icon name="left" />
      </button>
      <span role="status">
        {view.name} · {viewNumber.value! + 1} of {trainingViews.value!.views.length}
      </span>
      <button class="ghost" aria-label={`Next ${what}`} title={titleFor('nextView')} onClick={() => stepView(1)}>
        <Icon name="right" />
      </button>
      <button class="ghost" aria-label="Leave the view" title={titleFor('photographs', 'Leave: the camera goes back to where it was')} onClick={() => showPhotographs(false)}>
        <Icon name="close" />
      </button>
    </nav>
  );
}

export function Compare() {
  return (
    <>
      <CapturedStill />
      <Photograph />
      <Divider />
      <ViewBar />
    </>
  );
}

export function CompareSection() {
  const known = trainingViews.value;
  const count = known?.views.length ?? 0;
  return (
    <Section title="Compare">
      <Switch label="Split the window" title={titleFor('split', 'The object as captured on the left, or the photograph; as it is now on the right. Drag the line, or move it with the arrow keys')} value={split.value !== null} onChange={toggleSplit} />
      {count > 0 && (
        <>
          <Switch
            label={known!.has_photographs ? 'Photographs, from their own cameras' : 'Look through the cameras of the capture'}
            title={titleFor('photographs', 'Begins with the one nearest to the present view; the arrow keys go on. Leaving brings the camera back')}
            value={viewNumber.value !== null}
            onChange={showPhotographs}
          />
          {viewNumber.value !== null && (
            <Slider label="View" value={viewNumber.value + 1} min={1} max={Math.max(2, count)} step={1} onChange={(value) => (viewNumber.value = Math.min(count, value) - 1)} />
          )}
          {photographInSight.value && split.value === null && (
            <Slider label="Photograph" unit="%" value={photographOpacity.value} min={0} max={100} step={1} onChange={(value) => (photographOpacity.value = value)} />
          )}
        </>
      )}
      {known && count === 0 && <p class="hint">There are no photographs to compare with: this asset was made from a mesh, not from a capture.</p>}
      {known && count > 0 && !known.has_photographs && <p class="hint">The photographs were not kept with this asset: it was built before that was done. Build the capture again to compare with them.</p>}
    </Section>
  );
}
