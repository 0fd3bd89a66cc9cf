/** Handles that pull the object: put by a click, moved by arrows on the picture or by numbers here. */

import { keyOfGesture, newKey } from '../../edit/gestures';
import { objectRadius } from '../../edit/mesh';
import { handlesOf, keyOf, overruled } from '../../edit/shape/handles';
import { choose, chooseShapeTool, chosen, gizmoMode, grabbables, letGo, moveGrabbed, putBack, putHandleInFront, reach, removeChosen, removeHandles, setReach, shapeTool } from '../../edit/shape/shape_tools';
import { edits } from '../../session/edit_log';
import { Choice, PlaceField, Section, Slider, Switch } from '../fields';
import { titleFor } from '../shortcuts';

export function Handles() {
  const on = shapeTool.value === 'handles';
  const count = handlesOf(edits.value).length;
  return (
    <Section title="Handles">
      <Switch label="Handles on the picture" value={on} onChange={(next) => chooseShapeTool(next ? 'handles' : 'none')} />
      {on && overruled(edits.value) ? (
        <p class="hint" role="status">
          What moves now says where everything is: remove it under Simulation first.
        </p>
      ) : (
        on && <Tool count={count} />
      )}
      {!on && <p class="hint">{count > 0 ? `${count} in force.` : 'Take hold of the object and pull: the rest follows as rigidly as it can.'}</p>}
    </Section>
  );
}

function Tool({ count }: { count: number }) {
  const active = chosen.value;
  const held = active && handlesOf(edits.value).find((part) => keyOf(part) === active.key);
  const share = held?.grip.point ? (held.grip.radius ?? 0) / Math.max(1e-9, objectRadius.value) : reach.value;
  return (
    <>
      <Grabbed
        name="Handle"
        hint={
          count === 0
            ? 'Click on the object to put a handle. It stays where it is until you move it.'
            : count === 1
              ? 'Put another one: what is to move, and what is to stay. One alone takes the whole object along.'
              : 'Drag one: the picture follows the hand. White ones stay, orange ones were moved.'
        }
      />
      <Slider
        label="Reach"
        value={share}
        min={0}
        max={0.6}
        step={0.01}
        onChange={(value) => {
          reach.value = value;
          if (active && held?.grip.point) setReach(active.key, value * objectRadius.value, keyOfGesture(`reach ${active.key}`));
        }}
      />
      <div class="buttons">
        <button title="On the part of the object that is nearest to the eye" onClick={putHandleInFront}>
          Add one in front
        </button>
        {count > 0 && <button onClick={removeHandles}>Remove all</button>}
      </div>
    </>
  );
}

/** What the gizmo can take hold of, as a list, and the chosen one's numbers. */
export function Grabbed({ name, hint }: { name: 'Handle' | 'Corner'; hint: string }) {
  const all = grabbables.value;
  const active = chosen.value;
  const step = 10 ** Math.floor(Math.log10(Math.max(1e-9, objectRadius.value)) - 1.5);
  const move = (place: [number, number, number], turn: [number, number, number]) => {
    moveGrabbed(active!.key, place, turn, newKey());
    letGo();
  };
  return (
    <>
      <p class="hint" role="status">
        {hint}
      </p>
      {all.length > 0 && all.length <= 64 && (
        <div class="handles" role="group" aria-label={`${name}s`}>
          {all.map(({ key, moved }, i) => (
            <button key={key} class={moved ? 'moved' : undefined} aria-pressed={key === active?.key} aria-label={`${name} ${i + 1}, ${moved ? 'moved' : name === 'Handle' ? 'stays' : 'at rest'}`} onClick={() => choose(key === active?.key ? null : key)}>
              {i + 1}
            </button>
          ))}
        </div>
      )}
      {active && (
        <>
          {active.turn && (
            <Choice bare label="Arrows" value={gizmoMode.value} options={[{ value: 'translate', text: 'Move', title: titleFor('turn') }, { value: 'rotate', text: 'Turn', title: titleFor('turn') }]} onChange={(next) => (gizmoMode.value = next)} />
          )}
          <PlaceField label="Place" value={active.place} step={step} onEnter={(place) => move(place, active.turn ?? [0, 0, 0])} />
          {active.turn && <PlaceField label="Turn" unit="°" value={active.turn} step={1} onEnter={(turn) => move(active.place, turn)} />}
          <div class="buttons">
            <button disabled={!active.moved} onClick={() => putBack(active.key)}>
              Put back
            </button>
            {name === 'Handle' && (
              <button title={titleFor('remove')} onClick={removeChosen}>
                Remove
              </button>
            )}
          </div>
        </>
      )}
    </>
  );
}
