/** What a press on the picture means: a part to select, a stroke of a brush, a handle to put or to take hold of, a place to look at. */

import type CameraControls from 'camera-controls';
import type { PerspectiveCamera } from 'three';
import type { Vec3 } from '../session/view';
import { viewNumber } from '../capture/photographs';
import { nearestVertex } from '../edit/material/select_vertices';
import { paint, selectAt } from '../edit/material/selection';
import { mesh } from '../edit/mesh';
import { endStroke, paintPins } from '../edit/shape/pins';
import { choose, putHandle, shapeTool } from '../edit/shape/shape_tools';
import { notify } from '../session/notices';
import { pick } from '../session/session';
import type { Gizmo } from './gizmo';
import type { LocalPicture } from './local_picture';
import type { PointerActions } from './pointers';
import { shapeIsKnown } from './shape_now';
import { flying } from './switches';

/** A point of the object at rest, and the nearest vertex. */
type SurfacePoint = { rest: Vec3; vertex: number };

export class PointerTools implements PointerActions {
  constructor(
    private readonly stage: HTMLElement,
    private readonly camera: PerspectiveCamera,
    private readonly controls: CameraControls,
    private readonly gizmo: Gizmo,
    private readonly local: LocalPicture | null,
  ) {}

  grab = (event: PointerEvent) => this.gizmo.grab(event);
  drag = (event: PointerEvent) => this.gizmo.drag(event);
  release = (event: PointerEvent) => this.gizmo.release(event);

  select(event: MouseEvent): void {
    const tool = shapeTool.value;
    const take = (hit: SurfacePoint | null) => {
      if (tool === 'handles') hit ? putHandle(hit.rest) : choose(null);
      else if (hit) selectAt({ point: hit.rest, vertex: hit.vertex });
    };
    const hit = this.pickLocally(event);
    if (hit) take(hit);
    else void this.pickOnServer(event).then(take);
  }

  paint(event: PointerEvent): boolean {
    if (!shapeIsKnown.value) {
      notify('The brush needs the shape in this browser: pause what plays, and leave the instant local picture on.', 'info');
      return false;
    }
    const hit = this.pickLocally(event);
    if (hit) (shapeTool.value === 'pins' ? paintPins : paint)(hit.rest, event.shiftKey);
    return hit !== null;
  }

  painted = () => endStroke();

  /** Put the focal point on the surface under the pointer; the server knows surfaces that the local mesh does not. */
  focus(event: MouseEvent): void {
    if (flying.value || viewNumber.value !== null) return;
    void pick(...this.shareAt(event))?.then((picked) => {
      if (picked.hit && picked.position) void this.controls.moveTo(...picked.position, true);
    });
  }

  /** Share of the picture's width and height at a pointer. */
  private shareAt(event: MouseEvent): [number, number] {
    const box = this.stage.getBoundingClientRect();
    return [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
  }

  private pickLocally(event: MouseEvent): SurfacePoint | null {
    const [x, y] = this.shareAt(event);
    return shapeIsKnown.value ? (this.local?.pick(this.camera, 2 * x - 1, 1 - 2 * y) ?? null) : null;
  }

  /** The server knows where surfaces are at rest that the browser cannot follow. */
  private async pickOnServer(event: MouseEvent): Promise<SurfacePoint | null> {
    const { hit, rest } = (await pick(...this.shareAt(event))) ?? { hit: false };
    const positions = mesh.value?.positions;
    return hit && rest && positions ? { rest, vertex: nearestVertex(positions, rest) } : null;
  }
}
