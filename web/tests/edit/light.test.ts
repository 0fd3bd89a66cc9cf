import { expect, it } from 'vitest';
import { lightOf } from '../../src/edit/light';

it('an environment edit without a file keeps the one in force', () => {
  expect(lightOf([{ op: 'environment', file: 'a.exr', rotation: 10 }, { op: 'environment', intensity: 2 }])).toEqual({ file: 'a.exr', rotation: 0, intensity: 2 });
  expect(lightOf([])).toEqual({ file: null, rotation: 0, intensity: 1 });
});
