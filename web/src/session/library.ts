/** Assets and environments that the server holds. */

import { signal } from '@preact/signals';
import * as api from './api';
import type { AssetInfo, EnvironmentInfo } from './protocol.gen';

/** Null until the server has answered. */
export const assets = signal<AssetInfo[] | null>(null);
export const environments = signal<EnvironmentInfo[]>([]);

export async function refreshAssets(): Promise<void> {
  assets.value = (await api.listAssets()).assets;
}

export async function refreshEnvironments(): Promise<void> {
  environments.value = (await api.listEnvironments()).environments;
}
