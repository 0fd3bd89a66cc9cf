/**
 * An environment as three.js wants it for lighting: a cube whose levels are filtered for growing roughness.
 *
 * Where the browser draws without a GPU, three.js' own size takes seconds of all cores for each light, and most of a minute for a large one. There the
 * cube is smaller; only mirrors show that.
 */

import { HalfFloatType, LinearMipmapLinearFilter, LinearSRGBColorSpace, WebGLCubeRenderTarget, type PMREMGenerator, type Texture, type WebGLRenderer } from 'three';

/** Pixels a side of the cube's faces without a GPU; three.js itself takes 256 or more. */
const SOFTWARE_SIDE = 128;
/** Of the roughest level, in log2: three.js' own. */
const ROUGHEST_LOG2 = 3;
/** As browsers name what draws with the processor: Chromium, Mesa, Windows. */
const SOFTWARE_NAMES = /swiftshader|llvmpipe|softpipe|software|basic render/i;

/** `sky`: lat-long. What it returned before is the caller's to dispose. */
export function filterEnvironment(pmrem: PMREMGenerator, sky: Texture, software: boolean): WebGLCubeRenderTarget {
  return software ? pmrem.fromEquirectangular(sky, smallCube()) : pmrem.fromEquirectangular(sky);
}

/** Whether the processor draws in place of a GPU; false where the browser keeps it for itself. */
export function drawsInSoftware(renderer: WebGLRenderer): boolean {
  const gl = renderer.getContext();
  const names = gl.getExtension('WEBGL_debug_renderer_info');
  return names !== null && isSoftware(String(gl.getParameter(names.UNMASKED_RENDERER_WEBGL)));
}

export const isSoftware = (name: string) => SOFTWARE_NAMES.test(name);

/** A target such as PMREMGenerator allocates. */
function smallCube(): WebGLCubeRenderTarget {
  const target = new WebGLCubeRenderTarget(SOFTWARE_SIDE, {
    minFilter: LinearMipmapLinearFilter,
    generateMipmaps: false,
    type: HalfFloatType,
    colorSpace: LinearSRGBColorSpace,
    depthBuffer: false,
  });
  const { texture } = target;
  texture.mipmaps = levelSides(SOFTWARE_SIDE).map((side) => ({ width: side, height: side }) as never);
  texture.isPMREMTexture = true;
  return target;
}

/** Of the levels, from the mirror's to the roughest. */
export function levelSides(side: number): number[] {
  return Array.from({ length: Math.log2(side) - ROUGHEST_LOG2 + 1 }, (_, level) => side >> level);
}
