/** Preferences: signals that this browser keeps over a reload. */

import { effect, signal, type Signal } from '@preact/signals';

/** Kept as JSON in the local storage, under `drgs.` and this name. */
export function preference<T>(name: string, initial: T): Signal<T> {
  const stored = localStorage.getItem(`drgs.${name}`);
  const value = signal<T>(stored === null ? initial : (JSON.parse(stored) as T));
  effect(() => localStorage.setItem(`drgs.${name}`, JSON.stringify(value.value)));
  return value;
}
