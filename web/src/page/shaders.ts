/**
 * How the page shades: the split-sum approximation of the BRDF of drgs/maths/brdf.py, with baked shadows and inter-reflection.
 *
 * Diffuse light is the product of a vertex' transfer and the light's harmonics; reflections come from a sheet (light.ts) with one level for each
 * roughness. Where the object stands in their way, of which transfer tells, they show what the surface itself sends.
 */

import { SHARP_SIDE, SHEET_WIDTH, sheetHeight, SOFT_SIDE } from './light';
import { F0, SRGB_GAMMA, SRGB_LINEAR_END, SRGB_OFFSET, SRGB_SCALE, SRGB_SLOPE } from '../session/constants.gen';

/** Normalisations of spherical harmonics: drgs/maths/spherical_harmonics.py. */
const K0 = 0.5 / Math.sqrt(Math.PI);
const K1 = Math.sqrt(3 / (4 * Math.PI));
const K20 = Math.sqrt(5 / (16 * Math.PI));
const K21 = Math.sqrt(15 / (4 * Math.PI));
/** Of the share of the sky that harmonics, which are blurred, tell of: what is darker is the object, and how much steeper the edge is. */
const SHADOW_END = 0.3;
const SHADOW_SLOPE = 1.6;

const number = (value: number) => (Number.isInteger(value) ? `${value}.0` : `${value}`);

const SRGB = `
uniform float exposure;

vec3 screenColor(vec3 radiance) {
  vec3 linear = clamp(radiance * exposure, 0.0, 1.0);
  vec3 curved = ${number(SRGB_SCALE)} * pow(linear, vec3(${number(1 / SRGB_GAMMA)})) - ${number(SRGB_OFFSET)};
  return mix(curved, ${number(SRGB_SLOPE)} * linear, lessThanEqual(linear, vec3(${number(SRGB_LINEAR_END)})));
}`;

/** Radiance about a direction, at a level between those of the sheet. */
const light = (levels: number) => `
uniform sampler2D light;

vec3 lightFrom(vec3 direction, float level) {
  vec2 place = direction.xy / (abs(direction.x) + abs(direction.y) + abs(direction.z));
  if (direction.z < 0.0) place = (1.0 - abs(place.yx)) * vec2(place.x < 0.0 ? -1.0 : 1.0, place.y < 0.0 ? -1.0 : 1.0);
  place = 0.5 * place + 0.5;
  float under = min(floor(level), ${number(levels - 2)});
  vec2 texel = vec2(${number(1 / SHEET_WIDTH)}, ${number(1 / sheetHeight(levels))});
  vec2 soft = vec2(${number(SHARP_SIDE + 1)}, ${number(SOFT_SIDE)} * under + 1.0) + place * ${number(SOFT_SIDE - 2)};
  vec2 sharp = under < 0.5 ? 1.0 + place * ${number(SHARP_SIDE - 2)} : soft - vec2(0.0, ${number(SOFT_SIDE)});
  return mix(textureLod(light, sharp * texel, 0.0).rgb, textureLod(light, soft * texel, 0.0).rgb, level - under);
}`;

/** Radiance of a place of the object, sRGB. `normal` is that of the surface, `sky` the share of it in reflections. */
const shade = (levels: number[]) => `
${SRGB}
${light(levels.length)}
uniform mat2 lightFromWorld; // of x and y: lights turn about z
uniform sampler2D factors;

float levelOf(float roughness) {
  ${levels
    .slice(1)
    .map((high, k) => `float l${k} = clamp((roughness - ${number(levels[k]!)}) * ${number(1 / (high - levels[k]!))}, 0.0, 1.0);`)
    .join('\n  ')}
  return ${levels
    .slice(1)
    .map((_, k) => `l${k}`)
    .join(' + ')};
}

vec3 shade(vec3 wo, vec3 n, vec3 albedo, vec3 diffuse, float roughness, float metallic, float sky) {
  float facing = dot(n, wo);
  vec3 mirror = 2.0 * facing * n - wo;
  mirror.xy = lightFromWorld * mirror.xy;
  vec3 arriving = lightFrom(mirror, levelOf(roughness));
  vec2 factor = textureLod(factors, vec2(max(facing, 0.001), roughness), 0.0).rg;
  vec3 reflectance = mix(vec3(${number(F0)}), albedo, metallic) * factor.x + factor.y;
  return screenColor(diffuse * (1.0 - metallic) + reflectance * mix(diffuse, arriving, sky));
}`;

/** `atVertices`: colours are found at vertices and spread over the faces, for machines that are slow. */
export const objectVertex = (levels: number[], atVertices: boolean) => `#version 300 es
layout(location = 0) in vec3 place;
layout(location = 1) in vec2 octahedral;
layout(location = 2) in vec3 transferA;
layout(location = 3) in vec3 transferB;
layout(location = 4) in vec3 transferC;
layout(location = 5) in vec4 rootsAndRoughness;
layout(location = 6) in float metallicOf;
uniform mat4 clipFromWorld;
uniform vec3 low, eye;
uniform float placeStep, normalStep, transferLow, transferStep;
uniform vec3 harmonics[9];
uniform vec3 tint;
uniform vec4 paint; // a colour, and its share
uniform vec2 setRoughness, setMetallic; // a value, and its share
out vec3 world, normal, albedo, diffuse;
out vec3 surface; // roughness, metallic, share of the sky in reflections
${atVertices ? `out vec3 shaded;\n${shade(levels)}` : ''}

void main() {
  world = low + place * placeStep;
  vec2 flatPlace = octahedral * normalStep - 1.0;
  normal = vec3(flatPlace, 1.0 - abs(flatPlace.x) - abs(flatPlace.y));
  float fold = max(-normal.z, 0.0);
  normal.xy -= fold * sign(normal.xy);
  normal = normalize(normal);
  vec3 roots = rootsAndRoughness.rgb;
  albedo = mix(roots * roots, paint.rgb, paint.a) * tint;
  vec3 a = transferLow + transferA * transferStep, b = transferLow + transferB * transferStep, c = transferLow + transferC * transferStep;
  diffuse = a.x * harmonics[0] + a.y * harmonics[1] + a.z * harmonics[2];
  diffuse += b.x * harmonics[3] + b.y * harmonics[4] + b.z * harmonics[5];
  diffuse += c.x * harmonics[6] + c.y * harmonics[7] + c.z * harmonics[8];
  diffuse = max(diffuse, 0.0) * albedo;
  vec3 wo = normalize(eye - world);
  float facing = dot(normal, wo);
  vec3 m = 2.0 * facing * normal - wo;
  // The transfer of light from about the mirrored direction, over that of a vertex which sees all the sky above it.
  float seen = dot(a, vec3(${number(K0)}, ${number(-K1)} * m.y, ${number(K1)} * m.z));
  seen += dot(b, vec3(${number(-K1)} * m.x, ${number(K21)} * m.x * m.y, ${number(-K21)} * m.y * m.z));
  seen += dot(c, vec3(${number(K20)} * (3.0 * m.z * m.z - 1.0), ${number(-K21)} * m.x * m.z, ${number(K21 / 2)} * (m.x * m.x - m.y * m.y)));
  float open = ${number(K0 * K0)} * (0.375 + 2.0 * facing + 1.875 * facing * facing);
  float sky = clamp((seen / max(open, 0.001) - ${number(SHADOW_END)}) * ${number(SHADOW_SLOPE)}, 0.0, 1.0);
  surface = vec3(mix(rootsAndRoughness.a, setRoughness.x, setRoughness.y), mix(metallicOf, setMetallic.x, setMetallic.y), sky);
  ${atVertices ? 'shaded = shade(wo, normal, albedo, diffuse, surface.x, surface.y, sky);' : ''}
  gl_Position = clipFromWorld * vec4(world, 1.0);
}`;

export const SHADED_FRAGMENT = `#version 300 es
precision mediump float;
in vec3 shaded;
out vec4 color;

void main() {
  color = vec4(shaded, 1.0);
}`;

/** `levels`: the roughness that each level of the light is filtered for. */
export const objectFragment = (levels: number[]) => `#version 300 es
precision highp float;
in vec3 world, normal, albedo, diffuse;
in vec3 surface;
uniform vec3 eye;
out vec4 color;
${shade(levels)}

void main() {
  vec3 wo = normalize(eye - world);
  vec3 n = normalize(normal);
  if (!gl_FrontFacing && dot(n, wo) < 0.0) n = -n;
  color = vec4(shade(wo, n, albedo, diffuse, surface.x, surface.y, surface.z), 1.0);
}`;

/** One triangle over the whole picture. */
export const SKY_VERTEX = `#version 300 es
uniform mat4 worldFromClip;
uniform vec3 eye;
out vec3 direction;

void main() {
  vec2 corner = vec2(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0);
  vec4 far = worldFromClip * vec4(corner, 1.0, 1.0);
  direction = far.xyz / far.w - eye;
  gl_Position = vec4(corner, 1.0, 1.0);
}`;

export const skyFragment = (levels: number) => `#version 300 es
precision highp float;
in vec3 direction;
uniform mat2 lightFromWorld;
uniform float level;
out vec4 color;
${SRGB}
${light(levels)}

void main() {
  color = vec4(screenColor(lightFrom(vec3(lightFromWorld * direction.xy, direction.z), level)), 1.0);
}`;
