// Written by `python -m drgs_server.generate_types` from drgs/maths/constants.py and drgs/exchange/export_formats.py. Do not edit.

export const F0 = 0.04;
export const LUMINANCE_RED = 0.2126;
export const LUMINANCE_GREEN = 0.7152;
export const LUMINANCE_BLUE = 0.0722;
export const SRGB_SLOPE = 12.92;
export const SRGB_LINEAR_END = 0.0031308;
export const SRGB_ENCODED_END = 0.04045;
export const SRGB_SCALE = 1.055;
export const SRGB_OFFSET = 0.055;
export const SRGB_GAMMA = 2.4;
export const MIDDLE_GREY = 0.18;
export const STILL_BOUNCES = 4;
export const DEFAULT_FACES = 30000;
export const FEWEST_FACES = 4;
export const MOST_FACES = 2147483647;

export type DownloadFormat = "glb" | "mesh" | "html" | "ply" | "ply3" | "spz" | "usdz" | "usd" | "env" | "zip";

/** In the order in which they are offered. */
export const FILE_KINDS: { format: DownloadFormat; suffix: string; title: string; description: string; textured: boolean }[] = [
  { format: "glb", suffix: ".glb", title: "Mesh and Gaussians (GLB)", description: "Mesh with textures, occlusion and normals among them: Blender, three.js, Unreal, Unity; in a second scene the Gaussians (KHR_gaussian_splatting)", textured: true },
  { format: "mesh", suffix: ".glb", title: "Mesh (GLB)", description: "The same mesh alone, in a smaller file", textured: true },
  { format: "html", suffix: ".html", title: "Page (HTML)", description: "One file that any browser opens, without a server: the object to turn, relight and recolour", textured: false },
  { format: "ply", suffix: ".ply", title: "Gaussians (2DGS PLY)", description: "2D Gaussians with the field names of 2DGS: SuperSplat", textured: false },
  { format: "ply3", suffix: ".ply", title: "Gaussians (3DGS PLY)", description: "The same as flat ellipsoids, for viewers that want three scales", textured: false },
  { format: "spz", suffix: ".spz", title: "Gaussians (SPZ)", description: "The same in a seventh of the bytes, without materials: Scaniverse, Spark, Babylon.js and other viewers of compressed splats", textured: false },
  { format: "usdz", suffix: ".usdz", title: "Object for AR (USDZ)", description: "Mesh with textures, upright and in metres: AR Quick Look on iPhone and iPad, and what else reads USD", textured: true },
  { format: "usd", suffix: ".usdz", title: "Scene (USD)", description: "Mesh with textures, Gaussians as splats of OpenUSD 26 and the light as a dome, in one package; a .usda has its pictures beside it", textured: true },
  { format: "env", suffix: ".exr", title: "Light (EXR)", description: "The environment: with edits the chosen one, turned and dimmed; else the one recovered with the object", textured: false },
  { format: "zip", suffix: ".zip", title: "Asset (ZIP)", description: "Everything, to open here or with `drgs render`", textured: false },
];

export type SplatFormat = "sog" | "compressed";

/** What the browser writes of the Gaussians by itself. */
export const SPLAT_KINDS: { format: SplatFormat; suffix: string; title: string; description: string }[] = [
  { format: "sog", suffix: ".sog", title: "Gaussians (SOG)", description: "The Gaussians in a ninth of the bytes, for SuperSplat and PlayCanvas; takes minutes without a GPU" },
  { format: "compressed", suffix: ".compressed.ply", title: "Gaussians (compressed PLY)", description: "The Gaussians in a quarter of the bytes, for SuperSplat and PlayCanvas" },
];
