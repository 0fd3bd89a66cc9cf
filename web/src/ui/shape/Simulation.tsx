/** The object as matter: what it is made of, how it falls, and a timeline to play it. Moments are computed as they are first shown. */

import { keyOfGesture } from '../../edit/gestures';
import { density, dropHeight, fine, hasFloor, matter, MATTERS, matterValues, poisson, seconds, setDensity, setDropHeight, setFine, setFloor, setMatter, setPoisson, setSeconds, setStiffness, stiffness } from '../../edit/shape/matter';
import { bake, clips, loop, moment, playClip, playing, removeMotion, secondsOf, seek, simulate, speed } from '../../edit/shape/simulation';
import { Choice, Section, Slider, Switch } from '../fields';
import { Baking } from './Baking';
import { Pins } from './Pins';

/** Of a slider whose value is the matter's until it is moved. */
const unlessSet = (value: number | null, set: (next: number | null) => void) => ({
  unset: value === null,
  onChange: (next: number) => set(next),
  onReset: value === null ? undefined : () => set(null),
});

export function Simulation() {
  const edit = moment.value;
  const own = matterValues.value;
  return (
    <Section title="Simulation">
      <Choice bare label="Matter" value={matter.value} options={MATTERS.map((name) => ({ value: name, text: name[0]!.toUpperCase() + name.slice(1) }))} onChange={setMatter} />
      {own.poisson !== null && <Slider label="Stiffness" title={stiffness.value === null ? 'Young’s modulus: it follows the object’s size until you set it' : 'Young’s modulus'} unit="kPa" logarithmic value={stiffness.value ?? 2} min={0} max={4} step={0.1} {...unlessSet(stiffness.value, setStiffness)} />}
      <Slider label="Density" title="Of the matter; water has 1 t/m³" unit="t/m³" logarithmic value={density.value ?? Math.log10(own.density)} min={-2} max={1.3} step={0.05} {...unlessSet(density.value, setDensity)} />
      {own.poisson !== null && <Slider label="Poisson" title="Poisson’s ratio: how much it gets thinner when it is drawn out; near 0.5 it keeps its volume" value={poisson.value ?? own.poisson} min={0} max={0.45} step={0.01} {...unlessSet(poisson.value, setPoisson)} />}
      <Pins />
      <Switch label="Ground" value={hasFloor.value} onChange={setFloor} />
      {hasFloor.value && <Slider label="Drop from" unit="×" value={dropHeight.value} min={0} max={2} step={0.05} onChange={setDropHeight} />}
      <Slider label="Length" unit="s" value={seconds.value} min={0.25} max={5} step={0.25} onChange={setSeconds} />
      <Switch label="Fine (slow)" value={fine.value} onChange={setFine} />
      <div class="buttons">
        <button class="primary" onClick={simulate}>
          {edit ? 'Start again' : 'Let it go'}
        </button>
        <button title="Compute all of it on a worker first" onClick={() => void bake()}>
          Bake as a job
        </button>
        {edit && <button onClick={removeMotion}>Remove</button>}
      </div>
      <Baking />
      {clips.value.length > 0 && (
        <ul class="files" aria-label="Clips">
          {clips.value.map((job) => (
            <li>
              <button aria-pressed={edit?.op === 'pose' && edit.clip === job.clip} onClick={() => playClip(job.clip!)}>
                Play {job.name}
              </button>
            </li>
          ))}
        </ul>
      )}
      {edit && (
        <div class="timeline" role="group" aria-label="Timeline">
          <button onClick={() => (playing.value = !playing.value)}>{playing.value ? 'Pause' : 'Play'}</button>
          <Slider label="Time" unit="s" value={edit.time} min={0} max={secondsOf(edit)} step={0.01} onChange={(value) => { playing.value = false; seek(edit, value, keyOfGesture('time')); }} />
          <Choice label="Speed" value={speed.value} options={['0.25', '0.5', '1'].map((value) => ({ value, text: `${value}×` }))} onChange={(value) => (speed.value = value)} />
          <Switch label="Loop" value={loop.value} onChange={(value) => (loop.value = value)} />
        </div>
      )}
      <p class="hint">A moment is computed when it is first shown, so the first round is slow.</p>
    </Section>
  );
}
