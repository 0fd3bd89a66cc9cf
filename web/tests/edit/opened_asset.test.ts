import { beforeEach, expect, it } from 'vitest';
import { chooseTool, selectAt, selection, tool } from '../../src/edit/material/selection';
import { mesh } from '../../src/edit/mesh';
import { session } from '../../src/session/session';
import { strip } from './material/strip';

const open = (id: string, asset: string) => (session.value = { id, asset, assetName: asset });

beforeEach(() => {
  open('first', 'cup');
  mesh.value = strip();
  chooseTool('sphere');
  selectAt({ point: [1, 2, 3], vertex: 0 });
});

it('an asset that is opened again, or recovered, keeps its mesh and what is selected', () => {
  open('second', 'cup');
  expect(mesh.value).not.toBe(null);
  expect(selection.value.sphere?.center).toEqual([1, 2, 3]);
});

it('another asset begins with no mesh, all of it selected, and no place to select around', () => {
  open('second', 'plate');
  expect(mesh.value).toBe(null);
  expect([tool.value, selection.value]).toEqual(['all', { all: true }]);
  chooseTool('sphere');
  expect(selection.value).toEqual({ all: true });
});
