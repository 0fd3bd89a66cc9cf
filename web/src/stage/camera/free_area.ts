/** The part of the window that no bar or open panel covers. */

/** Up to here panels lie below the picture, and the bar of views above it (style.css) [CSS pixels]. */
const PHONE_WIDTH = 620;

/** Its centre and size [CSS pixels]. */
export function freeArea(width: number, height: number): { x: number; y: number; width: number; height: number } {
  const { left, right, top, bottom } = freeEdges(width, height);
  if (right <= left || bottom <= top) return { x: width / 2, y: height / 2, width, height }; // panels cover all
  return { x: (left + right) / 2, y: (top + bottom) / 2, width: right - left, height: bottom - top };
}

/** Its edges [CSS pixels]. */
export function freeEdges(width: number, height: number): { left: number; right: number; top: number; bottom: number } {
  const edge = (selector: string, side: 'left' | 'right' | 'top' | 'bottom') => document.querySelector(selector)?.getBoundingClientRect()[side];
  const narrow = width <= PHONE_WIDTH;
  const top = edge('.topbar', 'bottom') ?? 0;
  if (narrow) return { left: 0, right: width, top: edge('.view-bar', 'bottom') ?? top, bottom: edge('.panel', 'top') ?? edge('.hud', 'top') ?? height };
  return {
    left: edge('.library', 'right') ?? 0,
    right: edge('.inspector', 'left') ?? width,
    top,
    bottom: edge('.view-bar', 'top') ?? edge('.hud', 'top') ?? height,
  };
}
