/** What the picture can show, in the order of their keys, and how to read it. The server paints them (server/drgs_server/render/channels.py). */

import { LEAST_SHOWN_ERROR, type Settings } from '../session/protocol.gen';

export type Channel = NonNullable<Settings['channel']>;

export interface ChannelEntry {
  value: Channel;
  text: string;
  title: string;
  /** It needs samples, and gets better with each. */
  lit?: true;
  /** How to read the colours; absent where they are the object's own. */
  legend?: string;
  /** A bar of colours with what its ends and steps stand for. */
  scale?: { kind: 'grey' | 'heat'; marks: string[] };
}

const GREY = { kind: 'grey' as const, marks: ['0', '1'] };

export const CHANNELS: ChannelEntry[] = [
  { value: 'final', lit: true, text: 'Final', title: 'The finished picture' },
  { value: 'albedo', text: 'Albedo', title: 'Base colour without any light' },
  { value: 'roughness', text: 'Rough', title: 'Roughness', legend: 'Black is a mirror, white is matt.', scale: GREY },
  { value: 'metallic', text: 'Metal', title: 'Metallic', legend: 'White is metal.', scale: GREY },
  { value: 'normal', text: 'Normal', title: 'Which way the surface faces', legend: 'Red is +x, green is +y, blue is up (+z) in the world; middle grey is across.' },
  { value: 'depth', text: 'Depth', title: 'Distance from the camera', legend: 'The nearest point is white, the farthest dark grey.' },
  { value: 'visibility', lit: true, text: 'Open sky', title: 'Visibility: the share of the sky that a place sees', legend: 'White sees all of the sky over it, black is shut in. Light and material play no part.', scale: GREY },
  { value: 'indirect', lit: true, text: 'Indirect', title: 'Only light that met another surface on its way', legend: 'Black gets all its light straight from the environment. With no indirect bounces set, one is shown.' },
  {
    value: 'variance',
    lit: true,
    text: 'Noise',
    title: 'Variance: the standard error that each pixel still has',
    legend: 'By how much a pixel may still be off, where 1 is white on the screen. Every four times as many samples halve it.',
    scale: { kind: 'heat', marks: [String(LEAST_SHOWN_ERROR), '0.03', '1'] },
  },
  { value: 'surfels', text: 'Surfels', title: 'The 2D Gaussians that the object is made of', legend: 'A disc each, of one standard deviation and in a colour of its own; darker where it is seen from the side.' },
  {
    value: 'certainty',
    text: 'Certainty',
    title: 'What the photographs decide, and what is a guess',
    legend: 'Red is shape, green albedo, blue the less certain of roughness and metallic: white is known from the photographs, black is a guess. Of the object as captured: edits do not change it.',
  },
];

export const entryOf = (channel: Channel) => CHANNELS.find(({ value }) => value === channel) ?? CHANNELS[0]!;
