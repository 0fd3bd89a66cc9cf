/** A brush over the capture's pictures: strokes say what is the object and what is not, and the masks of all pictures follow while one draws. */

import { useEffect, useRef, useState } from 'preact/hooks';
import { areEnough, ledTo, withStroke, type Place } from '../../capture/strokes';
import * as api from '../../session/api';
import type { CaptureInfo, CaptureLook, CaptureMasks, Stroke } from '../../session/protocol.gen';
import { Choice } from '../fields';
import { Icon } from '../icons';

/** After the last stroke, before masks are asked for [ms]: whoever draws on is not finished. */
const PAUSE_MS = 700;
const WIDTHS = { thin: 0.005, middle: 0.01, wide: 0.025 } as const;
/** How far a key moves the brush, of the picture; with Shift five times as far. */
const KEY_STEP = 0.01;
const FASTER = 5;
const INK = { object: '#50dc78', background: '#f0463c' } as const;

type Kind = Stroke['shows'];

interface Props {
  info: CaptureInfo;
  look: CaptureLook;
  /** Of look.cameras. */
  number: number;
  onNumber(number: number): void;
  strokes: Stroke[];
  onStrokes(strokes: Stroke[]): void;
  onMasks(masks: CaptureMasks | null): void;
}

export function Strokes({ info, look, number, onNumber, strokes, onStrokes, onMasks }: Props) {
  const [shows, setShows] = useState<Kind>('object');
  const [width, setWidth] = useState<keyof typeof WIDTHS>('middle');
  const said = useMasks(info, strokes, onMasks);
  const { name } = look.cameras[number]!;
  const count = look.cameras.length;
  const pictures = new Set(strokes.map((stroke) => stroke.picture));
  const onKey = (event: KeyboardEvent) => {
    if (event.key.toLowerCase() !== 'z' || !(event.ctrlKey || event.metaKey) || event.shiftKey) return;
    event.preventDefault();
    event.stopPropagation(); // else an edit of the open object would be taken back
    onStrokes(strokes.slice(0, -1));
  };
  return (
    <div class="strokes" onKeyDown={onKey}>
      <Brush info={info} look={look} number={number} strokes={strokes} shows={shows} radius={WIDTHS[width]} onDraw={(stroke) => onStrokes(withStroke(strokes, stroke))} onShows={setShows} />
      <div class="strokes-tools">
        <Choice
          label="The brush shows"
          value={shows}
          options={[
            { value: 'object', text: 'Object', title: 'What is to be built. Key X changes it' },
            { value: 'background', text: 'Not object', title: 'What is around it: what it stands on above all. Key X changes it' },
          ]}
          onChange={(chosen) => setShows(chosen)}
        />
        <Choice
          label="Brush"
          value={width}
          options={[
            { value: 'thin', text: 'Thin' },
            { value: 'middle', text: 'Middle' },
            { value: 'wide', text: 'Wide' },
          ]}
          onChange={(chosen) => setWidth(chosen)}
        />
        <div class="strokes-row">
          <button type="button" aria-label="Picture before" title="Picture before" onClick={() => onNumber((number + count - 1) % count)}>
            <Icon name="left" />
          </button>
          <select aria-label="Picture" value={String(number)} onChange={(event) => onNumber(Number(event.currentTarget.value))}>
            {look.cameras.map((camera, k) => (
              <option value={String(k)}>{pictures.has(camera.name) ? `${camera.name} ✎` : camera.name}</option>
            ))}
          </select>
          <button type="button" aria-label="Next picture" title="Next picture" onClick={() => onNumber((number + 1) % count)}>
            <Icon name="right" />
          </button>
        </div>
        <div class="strokes-row">
          <button type="button" disabled={strokes.length === 0} title="Take the last stroke back (Ctrl+Z)" onClick={() => onStrokes(strokes.slice(0, -1))}>
            Undo stroke
          </button>
          <button type="button" disabled={strokes.length === 0} title="Take all strokes back" onClick={() => onStrokes([])}>
            Clear
          </button>
        </div>
        <p role="status" class={said.isWrong ? 'warning' : 'hint'}>
          {said.text}
        </p>
        <p class="hint">
          A picture of the sheet can be clicked to draw on it; two a quarter turn apart do for most. With keys: arrows move the brush on {name}, Space puts it down and lifts it.
        </p>
      </div>
    </div>
  );
}

/** Ask for masks whenever strokes have changed, and say how that goes. */
function useMasks(info: CaptureInfo, strokes: Stroke[], onMasks: (masks: CaptureMasks | null) => void): { text: string; isWrong: boolean } {
  const [said, say] = useState({ text: '', isWrong: false });
  useEffect(() => {
    if (!areEnough(strokes)) {
      onMasks(null);
      say({ text: strokes.length === 0 ? 'Draw over the object, and over what is around it.' : `Draw over ${strokes[0]!.shows === 'object' ? 'what is not the object' : 'the object'}, too.`, isWrong: false });
      return;
    }
    const leaving = new AbortController();
    const find = async () => {
      say({ text: 'Finding the masks of all pictures…', isWrong: false });
      try {
        const masks = await api.findMasks(info.id, strokes, leaving.signal);
        if (leaving.signal.aborted) return;
        onMasks(masks);
        say({ text: 'The sheet below shows the masks. Draw more where an outline is wrong; the build uses them.', isWrong: false });
      } catch (error) {
        if (!leaving.signal.aborted) say({ text: (error as Error).message, isWrong: true });
      }
    };
    const pause = setTimeout(() => void find(), PAUSE_MS);
    return () => {
      clearTimeout(pause);
      leaving.abort();
    };
  }, [info.id, strokes]);
  return said;
}

interface BrushProps {
  info: CaptureInfo;
  look: CaptureLook;
  number: number;
  strokes: Stroke[];
  shows: Kind;
  radius: number;
  onDraw(stroke: Stroke): void;
  onShows(shows: Kind): void;
}

function Brush({ info, look, number, strokes, shows, radius, onDraw, onShows }: BrushProps) {
  const canvas = useRef<HTMLCanvasElement>(null);
  /** The stroke that is being drawn. */
  const [drawn, setDrawn] = useState<Stroke | null>(null);
  const [key, setKey] = useState<Place | null>(null);
  const [missing, setMissing] = useState(false);
  const { name, width, height } = look.cameras[number]!;
  useEffect(() => {
    setDrawn(null);
    setMissing(false);
  }, [info.id, number]);
  useEffect(() => {
    const context = canvas.current?.getContext('2d');
    if (!context) return;
    context.clearRect(0, 0, width, height);
    for (const stroke of [...strokes.filter((other) => other.picture === name), ...(drawn ? [drawn] : [])]) drawStroke(context, stroke, width, height);
    if (key) drawBrush(context, key, INK[shows], radius, width, height);
  }, [strokes, drawn, key, shows, radius, name, width, height]);

  const placeOf = (event: PointerEvent): Place => {
    const shown = canvas.current!.getBoundingClientRect();
    return [(event.clientX - shown.left) / shown.width, (event.clientY - shown.top) / shown.height];
  };
  const begin = (place: Place) => setDrawn(ledTo({ picture: name, shows, radius, points: [] }, place));
  const end = () => {
    if (drawn) onDraw(drawn);
    setDrawn(null);
  };
  const onKey = (event: KeyboardEvent) => {
    const across = Number(event.key === 'ArrowRight') - Number(event.key === 'ArrowLeft');
    const down = Number(event.key === 'ArrowDown') - Number(event.key === 'ArrowUp');
    const at: Place = key ?? [0.5, 0.5];
    if (across || down) {
      const step = KEY_STEP * (event.shiftKey ? FASTER : 1);
      const to = [at[0] + across * step, at[1] + down * step].map((value) => Math.min(1, Math.max(0, value))) as Place;
      setKey(to);
      if (drawn) setDrawn(ledTo(drawn, to));
    } else if (event.key === ' ') {
      setKey(at);
      if (drawn) end();
      else begin(at);
    } else if (event.key.toLowerCase() === 'x' && !event.ctrlKey && !event.metaKey) {
      onShows(shows === 'object' ? 'background' : 'object');
    } else return;
    event.preventDefault();
    event.stopPropagation();
  };
  return (
    <div class="brush" style={{ 'aspect-ratio': `${width} / ${height}`, '--aspect': width / height }}>
      {missing ? <p class="hint">This picture cannot be shown.</p> : <img src={api.capturePicture(info.id, number)} alt={`Picture ${name}`} draggable={false} onError={() => setMissing(true)} />}
      <canvas
        ref={canvas}
        width={width}
        height={height}
        tabIndex={0}
        role="application"
        aria-label={`Brush over ${name}: arrow keys move it, Space puts it down and lifts it, X changes what it shows`}
        data-strokes={strokes.filter((stroke) => stroke.picture === name).length}
        onKeyDown={onKey}
        onFocus={(event) => event.currentTarget.matches(':focus-visible') && setKey(key ?? [0.5, 0.5])}
        onBlur={() => setKey(null)}
        onPointerDown={(event) => {
          if (event.button !== 0) return;
          event.currentTarget.setPointerCapture(event.pointerId);
          setKey(null);
          begin(placeOf(event));
        }}
        onPointerMove={(event) => drawn && event.buttons !== 0 && setDrawn(ledTo(drawn, placeOf(event)))}
        onPointerUp={() => end()}
        onPointerCancel={() => setDrawn(null)}
      />
    </div>
  );
}

function drawStroke(context: CanvasRenderingContext2D, { points, shows, radius = WIDTHS.middle }: Stroke, width: number, height: number): void {
  context.strokeStyle = INK[shows];
  context.lineWidth = 2 * radius * Math.max(width, height);
  context.lineCap = context.lineJoin = 'round';
  context.beginPath();
  points.forEach(([x, y], k) => (k === 0 ? context.moveTo(x * width, y * height) : context.lineTo(x * width, y * height)));
  if (points.length === 1) context.lineTo(points[0]![0] * width, points[0]![1] * height);
  context.stroke();
}

/** Where the keys have moved it. */
function drawBrush(context: CanvasRenderingContext2D, [x, y]: Place, ink: string, radius: number, width: number, height: number): void {
  const unit = Math.max(width, height) / 200;
  for (const [color, line] of [['#000', 3 * unit], [ink, unit]] as const) {
    context.strokeStyle = color;
    context.lineWidth = line;
    context.beginPath();
    context.arc(x * width, y * height, Math.max(radius * Math.max(width, height), 3 * unit), 0, 2 * Math.PI);
    context.stroke();
  }
}
