/** What every test's file finds of a browser: a local storage in which nothing is kept. No stub, which would be gone after the first test. */

Object.assign(globalThis, { localStorage: { getItem: () => null, setItem: () => {} } });
