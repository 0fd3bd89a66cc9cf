/** The capture's small picture in 3D with what can be grabbed in it: the six sides of the build's box, and the arrow that points up. Each is a slider to the keyboard. */

import { useEffect, useRef, useState } from 'preact/hooks';
import { rotationToUp, SIDES, sideCenter, sideName, stepOf, turnedBack, valueOf, withSide, type Side } from '../../capture/build_box';
import type { BoxCorners, CaptureLook } from '../../session/protocol.gen';
import type { Vec3 } from '../../session/view';
import type { CapturePicture } from '../../stage/capture_picture';
import { theme } from '../layout';

const UPRIGHT: Vec3 = [0, 0, 1];
/** Keys move a side by a step and turn the arrow by this; with Shift by ten times as much. */
const TURN_DEGREES = 2;
const FASTER = 10;
/** A side that is seen from straight ahead hardly moves on the screen: its axis counts as at least this long there [CSS pixels a step]. */
const LEAST_PIXELS = 0.5;

interface Props {
  look: CaptureLook;
  /** Of the capture's own world. */
  up: Vec3;
  found: BoxCorners;
  box: BoxCorners;
  onUp(up: Vec3): void;
  onBox(box: BoxCorners): void;
}

export function CaptureView({ look, up, found, box, onUp, onBox }: Props) {
  const canvas = useRef<HTMLCanvasElement>(null);
  const stage = useRef<HTMLDivElement>(null);
  const picture = useRef<CapturePicture | null>(null);
  const [ready, setReady] = useState(false);
  const [missing, setMissing] = useState(false);
  const [leaning, setLeaning] = useState<Vec3>(UPRIGHT);
  const places = useRef({ box, leaning });
  places.current = { box, leaning };

  const placeHandles = () => {
    const drawn = picture.current;
    if (!drawn || !stage.current) return;
    const { box, leaning } = places.current;
    const at = [...SIDES.map((side) => sideCenter(box, side)), drawn.tip(leaning)].map((place) => drawn.onCanvas(place));
    stage.current.querySelectorAll<HTMLElement>('.grip').forEach((grip, k) => {
      const seen = at[k];
      grip.style.visibility = seen ? '' : 'hidden';
      if (seen) grip.style.transform = `translate(${seen.x.toFixed(1)}px, ${seen.y.toFixed(1)}px) translate(-50%, -50%)`;
    });
  };

  useEffect(() => {
    let gone = false;
    void import('../../stage/capture_picture').then(({ CapturePicture }) => {
      if (gone) return;
      try {
        picture.current = new CapturePicture(canvas.current!, placeHandles);
        setReady(true);
      } catch {
        setMissing(true);
      }
    });
    return () => {
      gone = true;
      picture.current?.dispose();
      picture.current = null;
      setReady(false);
    };
  }, []);
  // The found box follows from these two.
  useEffect(() => picture.current?.show(look, up, found), [ready, look, theme.value, up]);
  useEffect(() => picture.current?.showBox(box, leaning), [ready, look, theme.value, up, box, leaning]);

  if (missing) return <p class="capture-picture hint">This browser offers no WebGL 2, so the cameras cannot be drawn.</p>;

  /** The capture's direction of one in the upright world. */
  const choose = (direction: Vec3) => onUp(turnedBack(rotationToUp(up), direction).map((value) => Number(value.toFixed(4))) as Vec3);
  const dragSide = (side: Side) => (x: number, y: number, start: { x: number; y: number; box: BoxCorners }) => {
    const drawn = picture.current!;
    const step = stepOf(found);
    const from = drawn.onCanvas(sideCenter(start.box, side));
    const to = drawn.onCanvas(sideCenter(start.box, side).with(side.axis, valueOf(start.box, side) + step) as Vec3);
    if (!from || !to) return;
    const along = { x: to.x - from.x, y: to.y - from.y };
    const square = Math.max(along.x ** 2 + along.y ** 2, LEAST_PIXELS ** 2);
    const moved = ((x - start.x) * along.x + (y - start.y) * along.y) / square;
    onBox(withSide(start.box, side, valueOf(start.box, side) + moved * step, found));
  };
  const turn = (event: KeyboardEvent) => {
    const towards = arrowOf(event);
    if (!towards) return;
    event.preventDefault();
    const { right, out } = picture.current!.axes();
    const axis = towards.across !== 0 ? out : right;
    const sign = towards.across !== 0 ? -towards.across : -towards.upwards;
    choose(turnedAround(UPRIGHT, axis, (sign * (event.shiftKey ? FASTER : 1) * TURN_DEGREES * Math.PI) / 180));
  };
  const shown = look.cameras.length < look.camera_count ? `${look.cameras.length} of ${look.camera_count}` : String(look.camera_count);
  return (
    <figure class="capture-picture">
      <div class="capture-stage" ref={stage}>
        <canvas ref={canvas} role="img" aria-label={`${shown} cameras around the object. Drag to turn it.`} />
        {SIDES.map((side) => (
          <Grip
            key={sideName(side)}
            kind="side"
            label={`Side ${sideName(side)} of the box`}
            value={valueOf(box, side)}
            start={() => ({ box })}
            onDrag={dragSide(side)}
            onKey={(event) => {
              const towards = arrowOf(event);
              if (!towards) return;
              event.preventDefault();
              const steps = (towards.across || towards.upwards) * (event.shiftKey ? FASTER : 1);
              onBox(withSide(box, side, valueOf(box, side) + steps * stepOf(found), found));
            }}
          />
        ))}
        <Grip
          kind="up"
          label="Direction that points up"
          value={leaning[2]}
          start={() => ({})}
          onDrag={(x, y) => setLeaning(picture.current!.leaningAt(x, y))}
          onDrop={() => {
            setLeaning(UPRIGHT);
            choose(leaning);
          }}
          onKey={turn}
        />
      </div>
      <figcaption class="hint">
        {shown} cameras; the box was found by {look.box_origin === 'masks' ? 'what the masks allow' : 'what all cameras see'}. Drag its sides, or the arrow that points up; drag elsewhere to turn, scroll to
        zoom.
      </figcaption>
    </figure>
  );
}

interface GripProps<Start> {
  kind: 'side' | 'up';
  label: string;
  value: number;
  /** What a drag needs of the moment in which it began. */
  start(): Start;
  /** Places on the canvas [CSS pixels]. */
  onDrag(x: number, y: number, start: Start & { x: number; y: number }): void;
  onDrop?(): void;
  onKey(event: KeyboardEvent): void;
}

function Grip<Start>({ kind, label, value, start, onDrag, onDrop, onKey }: GripProps<Start>) {
  const began = useRef<(Start & { x: number; y: number }) | null>(null);
  const place = (event: PointerEvent) => {
    const { left, top } = (event.currentTarget as HTMLElement).parentElement!.getBoundingClientRect();
    return { x: event.clientX - left, y: event.clientY - top };
  };
  const end = () => {
    if (began.current) onDrop?.();
    began.current = null;
  };
  return (
    <div
      class={`grip ${kind}`}
      role="slider"
      tabIndex={0}
      aria-label={label}
      aria-valuenow={Number(value.toPrecision(4))}
      title={`${label}: drag it, or use the arrow keys`}
      onKeyDown={onKey}
      onPointerDown={(event) => {
        event.currentTarget.setPointerCapture(event.pointerId);
        event.stopPropagation();
        began.current = { ...start(), ...place(event) };
      }}
      onPointerMove={(event) => {
        if (!began.current) return;
        const { x, y } = place(event);
        onDrag(x, y, began.current);
      }}
      onPointerUp={end}
      onPointerCancel={end}
    />
  );
}

/** Where an arrow key points; null for other keys. */
function arrowOf({ key }: KeyboardEvent): { across: number; upwards: number } | null {
  const across = Number(key === 'ArrowRight') - Number(key === 'ArrowLeft');
  const upwards = Number(key === 'ArrowUp') - Number(key === 'ArrowDown');
  return across || upwards ? { across, upwards } : null;
}

/** Rodrigues' formula, for a unit axis. */
function turnedAround(v: Vec3, k: Vec3, angle: number): Vec3 {
  const [c, s] = [Math.cos(angle), Math.sin(angle)];
  const dot = v[0] * k[0] + v[1] * k[1] + v[2] * k[2];
  const cross = [k[1] * v[2] - k[2] * v[1], k[2] * v[0] - k[0] * v[2], k[0] * v[1] - k[1] * v[0]];
  return v.map((value, i) => c * value + s * cross[i]! + (1 - c) * dot * k[i]!) as Vec3;
}
