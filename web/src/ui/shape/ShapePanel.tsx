/** Twist, bend, stretch, handles, a lattice of eight corners, and matter that falls. */

import { bounds } from '../../edit/mesh';
import type { AnalyticMap } from '../../edit/shape/deform_maps';
import { readLattice, type Lattice } from '../../edit/shape/lattice';
import { adjustLattice, chooseShapeTool, draftMap, lattice, latticeOverruled, newestMap, removeMaps, shapeTool } from '../../edit/shape/shape_tools';
import { commitDraft } from '../../session/edit_log';
import { Section, Slider, Switch } from '../fields';
import { Grabbed, Handles } from './Handles';
import { Simulation } from './Simulation';

const removes = (type: AnalyticMap['type']) => () => removeMaps(type);

export function ShapePanel() {
  return (
    <>
      <Maps />
      <Handles />
      <Corners />
      <Simulation />
    </>
  );
}

const DEGREES = 180 / Math.PI;

function Maps() {
  const { minimum, maximum } = bounds.value;
  const height = Math.max(1e-6, maximum[2] - minimum[2]);
  // A bend whose centre of curvature lies inside the object is refused by the server.
  const reach = Math.max(Math.abs(minimum[0]), Math.abs(maximum[0]), 1e-6);
  const bendLimit = Math.floor(Math.min(180, (0.95 * height * DEGREES) / reach));
  const twist = newestMap('twist');
  const bend = newestMap('bend');
  const stretch = newestMap('stretch');
  return (
    <Section title="Deform">
      <Slider label="Twist" unit="°" value={(twist?.rate ?? 0) * height * DEGREES} min={-360} max={360} step={1} unset={!twist} onChange={(value) => draftMap({ type: 'twist', rate: value / DEGREES / height })} onCommit={commitDraft} onReset={twist ? removes('twist') : undefined} />
      <Slider label="Bend" unit="°" value={(bend?.curvature ?? 0) * height * DEGREES} min={-bendLimit} max={bendLimit} step={1} unset={!bend} onChange={(value) => draftMap({ type: 'bend', curvature: value / DEGREES / height })} onCommit={commitDraft} onReset={bend ? removes('bend') : undefined} />
      <Slider label="Stretch" unit="×" value={stretch?.factor ?? 1} min={0.3} max={3} step={0.01} unset={!stretch} onChange={(factor) => draftMap({ type: 'stretch', factor })} onCommit={commitDraft} onReset={stretch ? removes('stretch') : undefined} />
      <p class="hint">Angles are from foot to top. The traced picture follows when you let go.</p>
    </Section>
  );
}

function Corners() {
  const map = lattice.value;
  const now = map ? readLattice(map) : { top: 1, foot: 1, leanX: 0, leanY: 0 };
  const slider = (label: string, key: keyof Lattice, min: number, max: number, unit: string) => (
    <Slider label={label} unit={unit} value={now[key]} min={min} max={max} step={0.01} unset={!map} onChange={(value) => adjustLattice({ [key]: value })} onCommit={commitDraft} onReset={map ? () => resetCorner(key) : undefined} />
  );
  const resetCorner = (key: keyof Lattice) => {
    adjustLattice({ [key]: key === 'top' || key === 'foot' ? 1 : 0 });
    commitDraft();
  };
  const shown = shapeTool.value === 'lattice';
  return (
    <Section title="Lattice" open={false}>
      {slider('Top', 'top', 0.1, 3, '×')}
      {slider('Foot', 'foot', 0.1, 3, '×')}
      {slider('Lean X', 'leanX', -1, 1, '')}
      {slider('Lean Y', 'leanY', -1, 1, '')}
      <p class="hint">Widths of top and foot, and how far the top leans, in heights of the object.</p>
      <Switch label="Corners on the picture" value={shown} onChange={(on) => chooseShapeTool(on ? 'lattice' : 'none')} />
      {shown && <Grabbed name="Corner" hint={latticeOverruled.value ? 'What moves now says where everything is: remove it under Simulation first.' : 'Drag a corner, or choose one and enter where it goes. The object follows at once; the traced picture when you let go.'} />}
      {map && (
        <div class="buttons">
          <button onClick={removes('lattice')}>Remove the lattice</button>
        </div>
      )}
    </Section>
  );
}
