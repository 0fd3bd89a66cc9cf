/** What every test's file finds of a browser: a local storage in which nothing is kept. */

import { vi } from 'vitest';

vi.stubGlobal('localStorage', { getItem: () => null, setItem: () => {} });
