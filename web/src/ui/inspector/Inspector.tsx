/** Right-hand panel of the open asset: one tab a subject, the history under all of them. */

import type { ComponentType } from 'preact';
import { session } from '../../session/session';
import { ExportPanel } from '../export/ExportPanel';
import { inspectorShown, tab, type Tab } from '../layout';
import { ShapePanel } from '../shape/ShapePanel';
import { History } from './History';
import { LightPanel } from './LightPanel';
import { MaterialPanel } from './MaterialPanel';
import { ViewPanel } from './ViewPanel';

interface Page {
  id: Tab;
  text: string;
  Panel: ComponentType;
}
const PAGES: Page[] = [
  { id: 'material', text: 'Material', Panel: MaterialPanel },
  { id: 'light', text: 'Light', Panel: LightPanel },
  { id: 'shape', text: 'Shape', Panel: ShapePanel },
  { id: 'view', text: 'View', Panel: ViewPanel },
  { id: 'out', text: 'Export', Panel: ExportPanel },
];

export function Inspector() {
  if (!session.value || !inspectorShown.value) return null;
  const chosen = PAGES.find((page) => page.id === tab.value) ?? PAGES[0]!;
  const onKey = (event: KeyboardEvent) => {
    const step = event.key === 'ArrowRight' ? 1 : event.key === 'ArrowLeft' ? -1 : 0;
    if (!step) return;
    const next = PAGES[(PAGES.indexOf(chosen) + step + PAGES.length) % PAGES.length]!;
    tab.value = next.id;
    document.getElementById(`tab-${next.id}`)?.focus();
    event.preventDefault();
  };
  return (
    <aside class="panel inspector" aria-label="Inspector">
      <div class="tabs" role="tablist" aria-label="Inspector pages" onKeyDown={onKey}>
        {PAGES.map((page) => (
          <button key={page.id} id={`tab-${page.id}`} role="tab" aria-selected={page === chosen} aria-controls="tab-page" tabIndex={page === chosen ? 0 : -1} onClick={() => (tab.value = page.id)}>
            {page.text}
          </button>
        ))}
      </div>
      {/* The key: each page begins at its top, however far the one before was scrolled. */}
      <div key={chosen.id} id="tab-page" class="tab-page" role="tabpanel" aria-labelledby={`tab-${chosen.id}`} tabIndex={0}>
        <chosen.Panel />
      </div>
      <History />
    </aside>
  );
}
