/** The computed clear day among the stored environments: its file's name tells how high the sun stands (server/drgs_server/api/made_environments.py). */

export const SUN_AND_SKY = 'sun-and-sky.exr';
/** Degrees above the horizon. */
export const USUAL_SUN = 40;
export const LOWEST_SUN = 2;
export const HIGHEST_SUN = 85;

export const sunAndSky = (elevation: number) => (elevation === USUAL_SUN ? SUN_AND_SKY : `sun-and-sky-${elevation}.exr`);

/** Of an environment's file; null where it is another light. */
export function elevationOf(file: string | null): number | null {
  if (file === SUN_AND_SKY) return USUAL_SUN;
  const elevation = Number(/^sun-and-sky-([1-9][0-9]?)\.exr$/.exec(file ?? '')?.[1]);
  return elevation >= LOWEST_SUN && elevation <= HIGHEST_SUN ? elevation : null;
}

/** What a list calls the environment of a file; the server's titles, and of the sun also its height. */
export function environmentTitle(file: string): string {
  const elevation = elevationOf(file);
  if (elevation !== null) return elevation === USUAL_SUN ? 'Sun and sky' : `Sun ${elevation}° high`;
  if (file === 'three-point-lights.exr') return 'Three-point';
  const words = file.replace(/\.(exr|hdr)$/i, '').replace(/[-_]/g, ' ');
  return words.charAt(0).toUpperCase() + words.slice(1);
}
