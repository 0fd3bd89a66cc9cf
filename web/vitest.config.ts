import { mergeConfig } from 'vite';
import { defineConfig } from 'vitest/config';
import viteConfig from './vite.config';

export default mergeConfig(
  viteConfig,
  // The tests' files share a process and its modules: starting thirty takes three times as long as the tests. What they stub is put back after each.
  defineConfig({ test: { isolate: false, unstubGlobals: true, setupFiles: './tests/setup.ts' } }),
);
