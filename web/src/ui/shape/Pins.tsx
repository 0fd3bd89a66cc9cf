/** What a simulation holds in place: painted on the object, or one end of it. */

import { size } from '../../edit/material/selection';
import { holdEnd, holdNothing, pinnedShare } from '../../edit/shape/pins';
import { chooseShapeTool, shapeTool } from '../../edit/shape/shape_tools';
import { shapeIsKnown } from '../../stage/shape_now';
import { Slider, Switch } from '../fields';

export function Pins() {
  const on = shapeTool.value === 'pins';
  const share = 100 * pinnedShare.value;
  const held = share === 0 ? 'Nothing is held.' : `${share < 1 ? 'Less than 1' : Math.round(share)} % of the surface is held.`;
  return (
    <>
      <Switch label="Paint what stays" title="Drag over the object; Shift takes away" value={on} onChange={(next) => chooseShapeTool(next ? 'pins' : 'none')} />
      {(on || share > 0) && (
        <p class="hint" role="status">
          {on && !shapeIsKnown.value ? 'Painting needs the shape in this browser: pause what plays, and leave the instant local picture on.' : held}
        </p>
      )}
      {on && <Slider label="Brush" value={size.value} min={0.02} max={1} step={0.01} onChange={(value) => (size.value = value)} />}
      {(on || share > 0) && (
        <div class="buttons">
          <button title="Hold the highest part of the object" onClick={() => holdEnd('top')}>
            Hold the top
          </button>
          <button title="Hold the lowest part of the object" onClick={() => holdEnd('foot')}>
            Hold the foot
          </button>
          {share > 0 && <button onClick={holdNothing}>Hold nothing</button>}
        </div>
      )}
    </>
  );
}
