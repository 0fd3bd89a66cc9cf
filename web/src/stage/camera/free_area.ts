/** The part of the window that no bar or open panel covers. */

/** Its centre and size [CSS pixels]. */
export function freeArea(width: number, height: number): { x: number; y: number; width: number; height: number } {
  const { left, right, top, bottom } = freeEdges(width, height);
  if (right <= left || bottom <= top) return { x: width / 2, y: height / 2, width, height }; // panels cover all
  return { x: (left + right) / 2, y: (top + bottom) / 2, width: right - left, height: bottom - top };
}

/** Its edges [CSS pixels]. */
export function freeEdges(width: number, height: number): { left: number; right: number; top: number; bottom: number } {
  const edge = (selector: string, side: 'left' | 'right' | 'top' | 'bottom') => document.querySelector(selector)?.getBoundingClientRect()[side];
  const narrow = width < 620; // panels lie below the picture then
  return {
    left: narrow ? 0 : (edge('.library', 'right') ?? 0),
    right: narrow ? width : (edge('.inspector', 'left') ?? width),
    top: edge('.topbar', 'bottom') ?? 0,
    bottom: (narrow ? edge('.panel', 'top') : undefined) ?? edge('.view-bar', 'top') ?? edge('.hud', 'top') ?? height,
  };
}
