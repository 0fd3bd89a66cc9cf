import { expect, it } from 'vitest';
import { elevationOf, environmentTitle, HIGHEST_SUN, LOWEST_SUN, sunAndSky } from '../../src/edit/sun_and_sky';

it('a name tells the height of the sun that it was made of, and other names tell none', () => {
  for (let degrees = LOWEST_SUN; degrees <= HIGHEST_SUN; degrees++) expect(elevationOf(sunAndSky(degrees))).toBe(degrees);
  for (const name of [null, 'studio.exr', 'my-sun-and-sky.exr', 'sun-and-sky-90.exr', 'sun-and-sky-1.exr', 'sun-and-sky-040.exr']) expect(elevationOf(name)).toBe(null);
});

it('a list calls lights by words', () => {
  expect([40, 12].map((degrees) => environmentTitle(sunAndSky(degrees)))).toEqual(['Sun and sky', 'Sun 12° high']);
  expect(environmentTitle('three-point-lights.exr')).toBe('Three-point');
  expect(environmentTitle('my-sky_2.exr')).toBe('My sky 2');
});
