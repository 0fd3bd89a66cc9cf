import { describe, expect, it } from 'vitest';
import { isSoftware, levelSides } from '../../src/stage/filter_environment';

describe('filtering an environment', () => {
  it('knows what draws with the processor by the name that browsers give it', () => {
    const software = [
      'ANGLE (Google, Vulkan 1.3.0 (SwiftShader Device (Subzero) (0x0000C0DE)), SwiftShader driver)',
      'llvmpipe (LLVM 15.0.7, 256 bits)',
      'ANGLE (Microsoft, Microsoft Basic Render Driver Direct3D11 vs_5_0 ps_5_0)',
    ];
    const hardware = ['ANGLE (NVIDIA, NVIDIA GeForce RTX 3060 Direct3D11 vs_5_0 ps_5_0)', 'Apple M2', 'Mesa Intel(R) UHD Graphics 620 (KBL GT2)', ''];
    expect(software.map(isSoftware)).toEqual([true, true, true]);
    expect(hardware.map(isSoftware)).toEqual([false, false, false, false]);
  });

  it('halves the sides down to the roughest level', () => {
    expect(levelSides(128)).toEqual([128, 64, 32, 16, 8]);
  });
});
