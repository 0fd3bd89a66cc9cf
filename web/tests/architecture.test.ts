import { expect, it } from 'vitest';

/** Each may import those before it. */
const LAYERS = ['session', 'edit', 'capture', 'stage', 'ui', 'page'];

const SOURCES: Record<string, string> = Object.fromEntries(
  Object.entries(import.meta.glob('../src/**/*.{ts,tsx}', { query: '?raw', import: 'default', eager: true })).map(([path, text]) => [path.replace('../src/', ''), text as string]),
);

/** Files that a file imports; where `running` only those that the browser loads with it, not types and not what is imported later. */
function imported(path: string, running = false): string[] {
  const found: string[] = [];
  for (const [, type, names, dynamic, target] of SOURCES[path]!.matchAll(/(?:^import (type )?([^;']*?)(?: from )?|(import\())'(\.[^']*)'/gm)) {
    const onlyTypes = type || (names && /^\{( type \w+,?)+ \}$/.test(names));
    const file = new URL(target!, `file:///${path}`).pathname.slice(1);
    const known = [file, `${file}.ts`, `${file}.tsx`].find((name) => name in SOURCES);
    if (known && !(running && (onlyTypes || dynamic))) found.push(known);
  }
  return found;
}

const layerOf = (path: string) => LAYERS.indexOf(path.split('/')[0]!);

it('every file but the first one lies in a layer', () => {
  expect(Object.keys(SOURCES).filter((path) => layerOf(path) < 0)).toEqual(['main.tsx']);
});

it('imports go one way', () => {
  const upwards = Object.keys(SOURCES).flatMap((path) => imported(path).filter((other) => path !== 'main.tsx' && layerOf(other) > layerOf(path)).map((other) => `${path} imports ${other}`));
  expect(upwards).toEqual([]);
  expect(imported('ui/App.tsx')).toContain('stage/viewport.ts'); // the pattern finds dynamic imports too
  expect(imported('stage/viewport.ts')).toContain('session/session.ts');
});

it('no file needs itself, by whatever way round', () => {
  const finished = new Set<string>();
  const visit = (path: string, way: string[]): void => {
    expect(way, `a cycle: ${[...way, path].join(' → ')}`).not.toContain(path);
    if (finished.has(path)) return;
    for (const other of imported(path)) visit(other, [...way, path]);
    finished.add(path);
  };
  for (const path of Object.keys(SOURCES)) visit(path, []);
});

it('panels do not wait for three.js', () => {
  const reached = new Set<string>();
  const visit = (path: string): void => {
    if (reached.has(path)) return;
    reached.add(path);
    imported(path, true).forEach(visit);
  };
  visit('main.tsx');
  expect(reached).toContain('ui/App.tsx');
  expect([...reached].filter((path) => /^import (?!type )[^;']* from '(three|camera-controls)/m.test(SOURCES[path]!))).toEqual([]);
});
