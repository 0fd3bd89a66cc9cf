/** Which part, and what it is made of. */

import { PRESETS } from '../../edit/material/preset_table';
import type { Rgb } from '../../edit/material/color';
import { assignMaterial, copiedMaterial, copyMaterial, forgetMaterial, materialThumbnails, namedMaterials, pasteMaterial, saveMaterial } from '../../edit/material/presets';
import { chooseTool, flash, selectAgain, selectedShare, selection, size, softness, tolerance, tool, type Tool } from '../../edit/material/selection';
import { editMaterial, factorOf, isSet, mean, mode, resetMaterial } from '../../edit/material/values';
import { commitDraft, edits } from '../../session/edit_log';
import type { MaterialValues } from '../../session/protocol.gen';
import { Choice, ColorField, Section, Slider } from '../fields';
import { Icon } from '../icons';
import { titleFor } from '../shortcuts';
import { Variants } from './Variants';

export function MaterialPanel() {
  return (
    <>
      <Part />
      <Values />
      <Variants />
      <Presets />
    </>
  );
}

const TOOLS: { value: Tool; text: string; title: string }[] = [
  { value: 'all', text: 'All', title: 'The whole object' },
  { value: 'region', text: 'Region', title: 'A patch up to where the captured material changes' },
  { value: 'similar', text: 'Similar', title: 'Connected places of much the same captured material' },
  { value: 'sphere', text: 'Sphere', title: 'What lies within a ball around a point' },
  { value: 'box', text: 'Box', title: 'What lies within a cube around a point' },
  { value: 'brush', text: 'Brush', title: 'Paint on the object; Shift takes away' },
];

function Part() {
  const chosen = tool.value;
  const nothing = chosen !== 'all' && selection.value.all;
  const share = selectedShare.value;
  const percent = share > 0 && share < 0.01 ? 'less than 1' : Math.round(100 * share);
  const shaped = chosen === 'sphere' || chosen === 'box' || chosen === 'brush';
  const change = (target: { value: number }) => (value: number) => {
    target.value = value;
    selectAgain();
  };
  return (
    <Section title="Part">
      <Choice bare label="Select by" value={chosen} options={TOOLS} onChange={chooseTool} />
      <p class="hint" role="status">
        {chosen === 'all'
          ? 'Changes go to the whole object.'
          : nothing
            ? chosen === 'brush'
              ? 'Paint on the object to select. Until then changes go to all of it.'
              : 'Click on the object to select. Until then changes go to all of it.'
            : `${percent} % of the object is selected.`}
      </p>
      {chosen === 'similar' && <Slider label="Tolerance" value={tolerance.value} min={0.01} max={1} step={0.01} onChange={change(tolerance)} />}
      {shaped && <Slider label="Size" value={size.value} min={0.02} max={1} step={0.01} onChange={change(size)} />}
      {shaped && <Slider label="Softness" value={softness.value} min={0} max={1} step={0.01} onChange={change(softness)} />}
      {!selection.value.all && (
        <div class="buttons">
          <button title={titleFor('all')} onClick={() => chooseTool('all')}>
            Select all
          </button>
          <button onClick={() => flash.value++}>Show selection</button>
        </div>
      )}
    </Section>
  );
}

function Values() {
  const multiply = mode.value === 'multiply';
  const select = selection.value;
  const now = edits.value;
  const value = mean.value;
  const reset = (key: keyof MaterialValues) => (isSet(now, select, key) ? () => resetMaterial(key) : undefined);
  const unset = (key: keyof MaterialValues) => !isSet(now, select, key);
  const slider = (label: string, key: 'roughness' | 'metallic') => (
    <Slider
      label={label}
      value={multiply ? (factorOf(now, select, key) ?? 1) : value[key]}
      min={0}
      max={multiply ? 4 : 1}
      step={0.01}
      unit={multiply ? '×' : undefined}
      unset={unset(key)}
      onChange={(number) => editMaterial({ [key]: number })}
      onCommit={commitDraft}
      onReset={reset(key)}
    />
  );
  return (
    <Section title="Material">
      <Choice
        bare
        label="Values"
        value={mode.value}
        options={[
          { value: 'absolute', text: 'Set', title: 'The same value everywhere' },
          { value: 'multiply', text: 'Multiply', title: 'Captured variation stays' },
        ]}
        onChange={(next) => (mode.value = next)}
      />
      <ColorField
        label={multiply ? 'Tint' : 'Colour'}
        value={multiply ? (factorOf(now, select, 'albedo') ?? [1, 1, 1]) : value.albedo}
        unset={unset('albedo')}
        onChange={(albedo: Rgb) => editMaterial({ albedo })}
        onCommit={commitDraft}
        onReset={reset('albedo')}
      />
      {slider('Roughness', 'roughness')}
      {slider('Metallic', 'metallic')}
      <div class="buttons">
        <button title={titleFor('copy')} onClick={copyMaterial}>
          Copy
        </button>
        <button title={titleFor('paste')} disabled={!copiedMaterial.value} onClick={pasteMaterial}>
          Paste
        </button>
        <button title="Keep this material in the list below, in this browser" onClick={saveMaterial}>
          Save
        </button>
      </div>
    </Section>
  );
}

function Presets() {
  return (
    <Section title="Presets">
      <div class="presets">
        {namedMaterials.value.map((material, i) => (
          <div class="preset">
            <button title={`Make the selection ${material.name.toLowerCase()}`} onClick={() => assignMaterial(material)}>
              {materialThumbnails.value[i] ? <img src={materialThumbnails.value[i]} alt="" /> : <span class="no-thumbnail" aria-hidden="true" />}
              <span>{material.name}</span>
            </button>
            {i >= PRESETS.length && (
              <button class="ghost forget" aria-label={`Forget ${material.name}`} title="Forget" onClick={() => forgetMaterial(material.name)}>
                <Icon name="close" />
              </button>
            )}
          </div>
        ))}
      </div>
    </Section>
  );
}
