import { ShaderChunk } from 'three';
import { expect, it } from 'vitest';
import { F0 } from '../../src/session/constants.gen';

it('dielectrics of the local picture reflect as those of the traced one', () => {
  expect(ShaderChunk.lights_physical_fragment).toContain(`material.specularColor = vec3( ${F0} );`);
});
