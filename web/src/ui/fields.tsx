/** Form pieces that every panel uses. While a value is dragged they show it, not the server's echo. */

import { useRef, useState } from 'preact/hooks';
import type { ComponentChildren, InputHTMLAttributes } from 'preact';
import type { Vec3 } from '../session/view';
import { hexFromLinear, linearFromHex, type Rgb } from '../edit/material/color';
import { Icon } from './icons';

export function Section({ title, children, open = true }: { title: string; children: ComponentChildren; open?: boolean }) {
  return (
    <details class="section" open={open}>
      <summary>{title}</summary>
      <div class="section-body">{children}</div>
    </details>
  );
}

type EntryProps = { type: 'text' | 'number'; value: string | number; onEnter(text: string): void } & Pick<
  InputHTMLAttributes,
  'class' | 'min' | 'max' | 'step' | 'title' | 'spellcheck' | 'maxLength' | 'aria-label' | 'aria-invalid'
>;

/** A text or a number that counts once it is entered. What is being typed stays, whatever news of the value arrives meanwhile.
 *
 * What is typed counts even where it reads as the value does: a time of 0.247 is shown as 0.25, and who types that means 0.25. Browsers call that
 * no change, so Enter is heard by itself. */
export function Entry({ value, onEnter, ...attributes }: EntryProps) {
  const [typed, setTyped] = useState<string | null>(null);
  const typing = useRef(false); // at once, where `typed` waits for the page: Enter may be followed by the browser's own change
  const leave = () => {
    typing.current = false;
    setTyped(null);
  };
  const enter = (text: string) => {
    if (!typing.current) return;
    leave();
    onEnter(text);
  };
  return (
    <input
      {...(attributes as object)}
      value={typed ?? value}
      onInput={(event) => {
        typing.current = true;
        setTyped(event.currentTarget.value);
      }}
      onKeyDown={(event) => event.key === 'Enter' && !event.isComposing && enter(event.currentTarget.value)}
      onChange={(event) => enter(event.currentTarget.value)}
      onBlur={leave}
    />
  );
}

interface SliderProps {
  label: string;
  value: number;
  min: number;
  max: number;
  step: number;
  unit?: string;
  /** `value` is a power of ten; the number field shows that power's value. */
  logarithmic?: boolean;
  /** Not set by the user yet: shown dimmed. */
  unset?: boolean;
  /** Tool-tip, where the label is not enough. */
  title?: string;
  onChange(value: number): void;
  /** The slider was let go, or a number typed. */
  onCommit?: () => void;
  /** Absent: there is nothing to go back to. */
  onReset?: () => void;
}

const clamp = (value: number, low: number, high: number) => Math.min(high, Math.max(low, value));

export function Slider({ label, value, min, max, step, unit, logarithmic, unset, title, onChange, onCommit, onReset }: SliderProps) {
  const [dragged, setDragged] = useState<number | null>(null);
  const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  const shown = dragged ?? value;
  const id = `slider-${label.toLowerCase().replace(/\W+/g, '-')}`;
  const set = (text: string) => {
    const number = logarithmic ? Math.log10(Number(text)) : Number(text);
    if (text.trim() === '' || !Number.isFinite(number)) return;
    onChange(clamp(number, min, max));
    onCommit?.();
  };
  return (
    <div class={`field${unset ? ' unset' : ''}`} title={title ?? (unset ? `${label}: as captured` : undefined)}>
      <label for={id}>{label}</label>
      <input
        id={id}
        type="range"
        min={min}
        max={max}
        step={step}
        value={clamp(shown, min, max)}
        style={{ '--share': `${(100 * (clamp(shown, min, max) - min)) / (max - min)}%` }}
        onInput={(event) => {
          setDragged(event.currentTarget.valueAsNumber);
          onChange(event.currentTarget.valueAsNumber);
        }}
        onChange={() => {
          setDragged(null);
          onCommit?.();
        }}
        onDblClick={onReset}
      />
      <span class="number">
        <Entry
          type="number"
          aria-label={`${label}, exact value`}
          min={logarithmic ? 10 ** min : min}
          max={logarithmic ? 10 ** max : max}
          step={logarithmic ? 'any' : step}
          value={logarithmic ? Number((10 ** shown).toPrecision(2)) : shown.toFixed(digits)}
          onEnter={set}
        />
        {unit && <span class="unit">{unit}</span>}
      </span>
      <ResetButton label={label} onReset={onReset} />
    </div>
  );
}

interface NumberProps {
  label: string;
  value: number;
  min: number;
  max: number;
  step: number;
  unit?: string;
  title?: string;
  /** Show no label: what stands beside it says it already. */
  bare?: boolean;
  onEnter(value: number): void;
}

/** A number that is only typed; what is out of bounds becomes the bound. */
export function NumberField({ label, value, min, max, step, unit, title, bare, onEnter }: NumberProps) {
  const take = (text: string) => {
    const number = Number(text);
    if (text.trim() !== '' && Number.isFinite(number)) onEnter(clamp(number, min, max));
  };
  return (
    <div class="number-field" title={title}>
      {!bare && <span aria-hidden="true">{label}</span>}
      <span class="number">
        <Entry type="number" aria-label={label} min={min} max={max} step={step} value={value} onEnter={take} />
        {unit && <span class="unit">{unit}</span>}
      </span>
    </div>
  );
}

function ResetButton({ label, onReset }: { label: string; onReset?: () => void }) {
  return (
    <button class="reset" title={`Reset ${label.toLowerCase()}`} aria-label={`Reset ${label.toLowerCase()}`} disabled={!onReset} onClick={onReset}>
      <Icon name="reset" />
    </button>
  );
}

interface ColorProps {
  label: string;
  value: Rgb;
  unset?: boolean;
  onChange(value: Rgb): void;
  onCommit?: () => void;
  onReset?: () => void;
}

/** A colour as sRGB (picker and hex) and as the linear numbers that the renderer uses. */
export function ColorField({ label, value, unset, onChange, onCommit, onReset }: ColorProps) {
  const [wrongHex, setWrongHex] = useState(false);
  const hex = hexFromLinear(value);
  const takeHex = (text: string) => {
    const linear = linearFromHex(text);
    setWrongHex(linear === null);
    if (linear) onChange(linear);
  };
  const typeHex = (text: string) => {
    takeHex(text);
    onCommit?.();
  };
  return (
    <div class={`color-field${unset ? ' unset' : ''}`}>
      <div class="field">
        <label for="color-picker">{label}</label>
        <input id="color-picker" type="color" value={hex} onInput={(event) => takeHex(event.currentTarget.value)} onChange={onCommit} />
        <Entry class="hex" type="text" aria-label={`${label}, sRGB hex`} aria-invalid={wrongHex} spellcheck={false} maxLength={7} value={hex} onEnter={typeHex} />
        <ResetButton label={label} onReset={onReset} />
      </div>
      <div class="field linear">
        <span class="label">Linear</span>
        {(['Red', 'Green', 'Blue'] as const).map((name, i) => (
          <Entry
            type="number"
            aria-label={`${label}, linear ${name.toLowerCase()}`}
            title={name}
            min={0}
            max={1}
            step={0.01}
            value={value[i]!.toFixed(3)}
            onEnter={(text) => {
              const number = Number(text);
              if (text.trim() === '' || !Number.isFinite(number)) return;
              onChange(value.map((old, k) => (k === i ? clamp(number, 0, 1) : old)) as Rgb);
              onCommit?.();
            }}
          />
        ))}
      </div>
    </div>
  );
}

interface PlaceProps {
  label: string;
  value: Vec3;
  step: number;
  unit?: string;
  onEnter(value: Vec3): void;
}

/** Three numbers: a place, or a turn. */
export function PlaceField({ label, value, step, unit, onEnter }: PlaceProps) {
  const digits = Math.max(0, Math.ceil(-Math.log10(step) - 1e-9));
  return (
    <div class="numbers" role="group" aria-label={label}>
      <span>{unit ? `${label} ${unit}` : label}</span>
      {(['x', 'y', 'z'] as const).map((name, i) => (
        <Entry
          type="number"
          aria-label={`${label} ${name}`}
          title={name}
          step={step}
          value={value[i]!.toFixed(digits)}
          onEnter={(text) => {
            const number = Number(text);
            if (text.trim() !== '' && Number.isFinite(number)) onEnter(value.with(i, number) as Vec3);
          }}
        />
      ))}
    </div>
  );
}

interface ChoiceProps<T extends string> {
  label: string;
  /** Null: none of them. */
  value: T | null;
  options: { value: T; text: string; title?: string }[];
  /** Show no label: what stands above says it already. */
  bare?: boolean;
  /** Absent: all in one row. */
  columns?: number;
  onChange(value: T): void;
}

/** One of a few, as joined buttons (radio buttons to a screen reader and the arrow keys). */
export function Choice<T extends string>({ label, value, options, bare, columns, onChange }: ChoiceProps<T>) {
  const name = `choice-${label.toLowerCase().replace(/\W+/g, '-')}`;
  return (
    <fieldset class="choice">
      <legend class={bare ? 'visually-hidden' : undefined}>{label}</legend>
      <div class={columns ? 'choice-row grid' : 'choice-row'} style={columns ? { '--columns': columns } : undefined}>
        {options.map((option) => (
          <label title={option.title}>
            <input type="radio" name={name} value={option.value} checked={option.value === value} onChange={() => onChange(option.value)} />
            <span>{option.text}</span>
          </label>
        ))}
      </div>
    </fieldset>
  );
}

export function Switch({ label, value, onChange, title }: { label: string; value: boolean; onChange(value: boolean): void; title?: string }) {
  return (
    <label class="switch" title={title}>
      <input type="checkbox" role="switch" checked={value} onChange={(event) => onChange(event.currentTarget.checked)} />
      <span>{label}</span>
    </label>
  );
}

/** How far something is, 0..1. */
export function Bar({ label, share }: { label: string; share: number }) {
  const percent = Math.round(100 * share);
  return (
    <div class="bar" role="progressbar" aria-label={label} aria-valuenow={percent} aria-valuemin={0} aria-valuemax={100}>
      <div style={{ width: `${percent}%` }} />
    </div>
  );
}
