// Written by `python -m drgs_server.generate_types` from messages.py and frame_header.py of server/drgs_server/live and server/drgs_server/api/rest_records.py. Do not edit.

export const PROTOCOL_VERSION = 1;
export const MAX_FRAMES_IN_FLIGHT = 2;
export const CLOSE_VERSION_MISMATCH = 1002;
export const MAX_SIDE = 4096;
export const MAX_PIXELS = 4194304;
export const MAX_STILL_PIXELS = 8847360;
export const MAX_LAYERED_PIXELS = 2211840;
export const MAX_STILL_SAMPLES = 1073741824;
export const LEAST_SHOWN_ERROR = 0.001;
export const NO_CERTAINTY = "this asset does not say what is certain: it was imported, or built by an older version or with materials on surfels";
export const FRAME_KIND_PICTURE = 1;
export const CODEC_JPEG = 0;
export const CODEC_PNG = 1;
export const FLAG_MOVING = 1;
export const FLAG_CONVERGED = 2;
export const FLAG_ALPHA = 4;
export const CAMERA_NUMBER_SHIFT = 8;

/** The 24 little-endian bytes before each picture; see docs/protocol.md. */
export interface FrameHeader {
  kind: number;
  codec: number;
  flags: number;
  frameId: number;
  stateRev: number;
  width: number;
  height: number;
  spp: number;
  sppTarget: number;
  renderMicroseconds: number;
}

export const FRAME_HEADER_BYTES = 24;

export function readFrameHeader(buffer: ArrayBuffer): FrameHeader {
  const view = new DataView(buffer, 0, FRAME_HEADER_BYTES);
  return {
    kind: view.getUint8(0),
    codec: view.getUint8(1),
    flags: view.getUint16(2, true),
    frameId: view.getUint32(4, true),
    stateRev: view.getUint32(8, true),
    width: view.getUint16(12, true),
    height: view.getUint16(14, true),
    spp: view.getUint16(16, true),
    sppTarget: view.getUint16(18, true),
    renderMicroseconds: view.getUint32(20, true),
  };
}

export interface AcceptedMessage {
  type: "accepted";
  id: number;
  /** Of the log with this edit in it; the edit is on disk. */
  revision: number;
}

/** This frame, and every one before it, has been shown or dropped. */
export interface AckMessage {
  type: "ack";
  frame_id: number;
}

export interface AssetInfo {
  id: string;
  name: string;
  created_at: string;
  bytes: number;
  /** build, upload or session. */
  source: string;
  /** 0 for an asset made from a mesh. */
  surfel_count: number;
  vertex_count: number;
  face_count: number;
  has_thumbnail: boolean;
  /** 1, or one more than the parent's. */
  version: number;
  /** The version that this one was made of. */
  parent_id: string | null;
  /** What was done to the parent. */
  edits: Edit[];
  /** Since when it can be brought back, for a while. */
  deleted_at: string | null;
}

export interface AssetList {
  /** Newest first. */
  assets: AssetInfo[];
  total: number;
}

export interface BendMap {
  type: "bend";
  curvature: number;
}

export interface Box {
  minimum: [number, number, number];
  maximum: [number, number, number];
  falloff?: number;
}

/** A box with sides along the axes, by two opposite corners [world units]. */
export interface BoxCorners {
  low: [number, number, number];
  high: [number, number, number];
}

/** An edit that applies no longer, for example since its file is gone: it is skipped, and taken out like any other. */
export interface BrokenEdit {
  /** Its place in `edits`, from 0. */
  index: number;
  /** A sentence. */
  reason: string;
}

/** A build of a capture that the server can already see. A zip may be uploaded as multipart instead, with the same fields. */
export interface BuildRequest {
  /** Shown in lists. */
  name?: string | null;
  /** Lower runs first; jobs of one priority run in the order in which they came. */
  priority?: number;
  limits?: JobLimits;
  kind?: "build";
  /**
   * `capture:ID` for an uploaded one (POST /api/captures), `sample` for the bundled one, or a folder below a root that was allowed when the
   * server started.
   */
  dataset: string;
  preset?: "draft" | "fast" | "full";
  /** particles: surfels lie where they were fitted. mesh: they are rebuilt on the faces of the mesh, one a face. */
  binding?: "particles" | "mesh";
  /** What the lamps stood still with: the object, or (on a turntable) the camera; auto: asked of the pictures. */
  light?: "auto" | "object" | "camera";
  /** Where masks end: where the photographs show the object to end, if that is elsewhere (auto), or as given. */
  masks?: "auto" | "given";
  /** Where photographs were taken from: where they fit the surface best, if that is elsewhere (auto), or as given. */
  cameras?: "auto" | "given";
  /** Direction of the capture's world that points up; the asset's world is turned so that it is z. Not of multipart bodies. */
  up?: [number, number, number];
  /**
   * Of the asset's world, which is the capture's turned by `up`: what lies outside is not built. Absent: all of the object is. Not of multipart
   * bodies.
   */
  box?: BoxCorners | null;
  /**
   * Over some of the capture's pictures: what is the object, and what is not. The masks of all pictures follow from them, whatever masks the capture has.
   * Not of multipart bodies.
   */
  strokes?: Stroke[] | null;
  seed?: number;
}

/** A view that a film passes through, with z up. */
export interface CameraKeyframe {
  eye: [number, number, number];
  /** Straight ahead: what the camera goes round on its way to the next view [world units]. */
  target: [number, number, number];
  fov_y_degrees?: number;
  /** From the view before to this one; that of the first counts on a closed path alone, from the last. */
  seconds?: number;
}

/** Where this viewer looks from. Latest wins: a newer one replaces one that was not rendered yet. */
export interface CameraMessage {
  type: "camera";
  /**
   * Chosen by the client; a frame carries the low 8 bits of the number of the camera that it shows. A new number is answered by a frame
   * even where nothing else is new: sent behind `settings`, it marks the frames that show them.
   */
  number?: number;
  /** OpenGL camera-to-world, rows: the camera looks down -z, y up. World is right-handed, z up. */
  world_from_camera: [[number, number, number, number], [number, number, number, number], [number, number, number, number], [number, number, number, number]];
  fov_y_degrees: number;
  /** Pixels of the picture at rest; while moving the server may send fewer. */
  width: number;
  height: number;
}

/** A film: the camera passes these views, smoothly in time and around what it looks at. */
export interface CameraPath {
  keyframes: CameraKeyframe[];
  /** Go on from the last view to the first without resting there, so that the film can be shown over and over. */
  closed?: boolean;
}

/**
 * Give up the change of this session that is being computed, such as a long simulation: it is answered by `rejected`. Nothing is done where
 * there is none.
 */
export interface CancelMessage {
  type: "cancel";
}

/** One thing that helps or hurts a build. */
export interface CaptureFinding {
  /** error: there is nothing to build from. */
  level: "error" | "warning" | "info";
  sentence: string;
  /** What to do about it; may be empty. */
  advice: string;
}

export interface CaptureInfo {
  /** A build says `capture:ID` to read it. */
  id: string;
  name: string;
  created_at: string;
  /** Ids of builds, of re-decouplings of what they made, and of searches for poses, that read it. Without any, it is removed a day after it came. */
  jobs: string[];
}

export interface CaptureList {
  /** Newest first. */
  captures: CaptureInfo[];
  total: number;
}

/** What can be seen of a capture before a build. */
export interface CaptureLook {
  /** Whether a build can start. */
  ok: boolean;
  /** How many pictures of what size and with what around them; empty where the capture cannot be read. */
  summary: string;
  findings: CaptureFinding[];
  /** Whether there are pictures to show (GET .../sheet.jpg). */
  has_sheet: boolean;
  /** None where there are none. */
  sheet?: SheetLayout | null;
  /** 0 where a build finds them first, or the capture cannot be read. */
  camera_count: number;
  /** All, or 400 evenly chosen. */
  cameras: TrainingView[];
  /** The mean of the cameras' own up, in the capture's world; None without cameras. */
  up: [number, number, number] | null;
  /** This and the next: corners of the object's box [world units]; None without cameras. */
  box_low: [number, number, number] | null;
  box_high: [number, number, number] | null;
  /** Whether the box is what all masks allow, or a guess by what all cameras see. */
  box_origin: "masks" | "cameras" | null;
  /**
   * Three numbers for each place that tells how far the object reaches in a turned world: boxes about them hold the hull of the masks. None where
   * the box is a guess; that is as wide in all directions.
   */
  outermost?: number[];
  /** Three numbers for each point on or about the object [world units]; 3000 points at most, none where nothing is known of them. */
  points: number[];
  /** Three for each point, sRGB 0..1. */
  colors: number[];
}

/** Masks of all pictures by strokes, to be looked at; a build that is told the same strokes finds them again. */
export interface CaptureMasks {
  /** Names the sheet: GET .../masks/{version}.jpg. */
  version: string;
  sheet: SheetLayout;
}

/** Of `drgs doctor`. */
export interface CaptureReport {
  /** How many pictures of what size and with what around them; empty where the capture cannot be read. */
  summary: string;
  findings: CaptureFinding[];
}

export interface CaptureRequest {
  /** Id of a complete upload: a zip of a capture. */
  upload: string;
  /** That of the uploaded file when absent. */
  name?: string | null;
}

/** First message of a client; nothing else is answered before it. */
export interface ClientHello {
  type: "hello";
  /** PROTOCOL_VERSION of the client. */
  v: number;
  /** What the client can decode. With png, the converged frame is lossless (and keeps alpha). */
  codecs?: ("jpeg" | "png")[];
  /** Be told of changes of the edit log (`change`), not of the whole log each time (`state`): a long log is then sent once. */
  changes?: boolean;
  /** Name of the program, for logs. */
  client?: string;
}

/** Exactly one of map, vertices, handles. */
export interface DeformEdit {
  op: "deform";
  map?: TwistMap | BendMap | StretchMap | LatticeMap | null;
  vertices?: string | null;
  time?: number;
  frames_per_second?: number;
  handles?: Handles | null;
}

/** The session's edits. The same document answers REST calls. */
export interface EditLog {
  /** Rises by one with every change; never falls. */
  revision: number;
  /** Those in force, in order. */
  edits: Edit[];
  can_undo: boolean;
  can_redo: boolean;
  /** How many of the edits, counted from the last, undo takes away one by one; what lies behind them goes in one step. */
  appended: number;
  /** Those that redo brings back one by one, the next one first; empty when the next redo does more than append one. */
  undone: Edit[];
  /** Of all that led to this log: two logs with the same digest are the same. */
  digest?: string;
  /** Those of `edits` that were skipped when the object was last posed; none before its asset was first loaded. */
  broken?: BrokenEdit[];
}

/** Append an edit to the session's log. Applied in order, never dropped, answered by `accepted` or `rejected`. */
export interface EditMessage {
  type: "edit";
  /** Chosen by the client; the answer repeats it. */
  id: number;
  edit: Edit;
  /**
   * Edits of one gesture, like the drag of a slider, share a key that no other has: an edit whose key is that of the newest change replaces
   * it. When a gesture ends is the client's to say: it sees the hand, and how late messages arrive tells nothing.
   */
  coalesce?: string | null;
  /**
   * Unique in the session, and the same when the client sends this edit again because it lost the connection before the answer: it is
   * then answered as before and not applied twice.
   */
  key?: string | null;
}

export interface EditRequest {
  edit: Edit;
}

export interface EditsRequest {
  edits: Edit[];
  /** Of the log that they are meant for: refused once there is a newer one. Absent: whatever is in force goes. */
  revision?: number | null;
}

export interface EnvironmentEdit {
  op: "environment";
  file?: string | null;
  rotation?: number;
  intensity?: number;
}

export interface EnvironmentInfo {
  /** What an environment edit's `file` says. */
  name: string;
  title: string;
  width: number;
  height: number;
}

export interface EnvironmentList {
  environments: EnvironmentInfo[];
}

/** Something the client did, or the server could not do. The connection lives on unless `fatal`. */
export interface ErrorMessage {
  type: "error";
  message: string;
  fatal: boolean;
}

/** What the newest picture cost, and what was left out of it, and why. */
export interface ExplainMessage {
  type: "explain";
  id: number;
}

export interface ExplainedMessage {
  type: "explained";
  id: number;
  /** Of the log that the picture shows; None while there is no picture, and then nothing else says anything. */
  revision: number | null;
  samples: number;
  samples_target: number;
  /** Spent on each step of the picture. */
  seconds: Record<string, unknown>;
  skipped: SkippedWork[];
  frames_sent: number;
  frames_in_flight: number;
  /** From a frame's sending to its acknowledgement, mean of the last ones. */
  round_trip_ms: number | null;
}

/** Files for other programs, kept with the job until it is deleted. */
export interface ExportRequest {
  /** Shown in lists. */
  name?: string | null;
  /** Lower runs first; jobs of one priority run in the order in which they came. */
  priority?: number;
  limits?: JobLimits;
  kind: "export";
  asset: string;
  formats: ("ply" | "ply3" | "spz" | "glb" | "mesh" | "usdz" | "usd" | "env" | "html" | "zip")[];
  /** The most that textured meshes (glb, mesh, usdz, usd) have; 30 000 where nothing is said. */
  faces?: number | null;
  /** Other materials, for the formats that hold some (glb, mesh, html). */
  variants?: MaterialVariant[];
}

/** A part of the surface that is held: some vertices by number, or those around a picked point. */
export interface Grip {
  vertices?: number[] | null;
  point?: [number, number, number] | null;
  radius?: number;
}

/** A grip that is dragged: it moves as a rigid piece. */
export interface Handle {
  vertices?: number[] | null;
  point?: [number, number, number] | null;
  radius?: number;
  target: [number, number, number];
  turn?: [number, number, number];
}

/** What is dragged and what is held in place; the rest follows as rigidly as it can. Parts without a grip stay. */
export interface Handles {
  drag?: Handle[];
  pin?: Grip[];
}

export interface JobFile {
  name: string;
  bytes: number;
  media_type: string;
}

export interface JobFileList {
  /** By name; complete once the job is done. */
  files: JobFile[];
}

export interface JobInfo {
  id: string;
  kind: "build" | "pose" | "redecouple" | "simulate" | "render" | "export";
  name: string;
  /** Empty where the kind has none. */
  preset: string;
  /** Lower runs first. */
  priority: number;
  state: "queued" | "running" | "stalled" | "done" | "failed" | "cancelled" | "unknown";
  created_at: string;
  finished_at: string | null;
  /** Of the build; empty before it starts. */
  stage: string;
  iteration: number;
  iterations: number;
  /** Of the whole job, 0..1. */
  fraction: number;
  psnr: number | null;
  eta_seconds: number | null;
  message: string;
  /** How often the work was started: 1 unless a worker died or it was retried. */
  attempts: number;
  /** What a build or a re-decoupling made; set when done. */
  asset_id: string | null;
  /** The capture that a `pose` made; set when done. */
  capture_id: string | null;
  /** What a job of another kind than `build` and `pose` works on. */
  source_asset: string | null;
  /** What a `pose` edit names to show a simulation; set when done. */
  clip: string | null;
  /** A sentence, when failed. */
  error: string | null;
  /** What `drgs doctor` finds in the capture of a build; there soon after it began. Of a `pose`, which pictures found no place. */
  capture: CaptureReport | null;
  /** Rises with each new preview picture; 0 while there is none. Use it to get round the browser's cache. */
  preview_version: number;
}

/** A job that goes beyond ends as failed, its checkpoint kept. */
export interface JobLimits {
  /** Of work since it was last started; waiting does not count. */
  seconds?: number | null;
  /** Resident, of the worker's process. */
  memory_bytes?: number | null;
}

export interface JobList {
  /** Newest first. */
  jobs: JobInfo[];
  total: number;
  workers_alive: number;
}

export interface LatticeMap {
  type: "lattice";
  minimum: [number, number, number];
  maximum: [number, number, number];
  control_points: [number, number, number][][][];
}

/** Of a list of edits: behind the first `start`, `edits` take the place of `remove`. */
export interface ListChange {
  start: number;
  remove: number;
  edits: Edit[];
}

/** Sent to every viewer that asked for `changes`, after each change of the session's edit log. */
export interface LogChangeMessage {
  type: "change";
  /** Digest of the log that is changed; who holds another one has missed something, and asks for the whole (`log`). */
  before: string;
  /** Of the log that it makes; the rest as in EditLog. */
  digest: string;
  revision: number;
  edits: ListChange;
  undone: ListChange;
  can_undo: boolean;
  can_redo: boolean;
  appended: number;
  /** All of the log that it makes. */
  broken?: BrokenEdit[];
}

/** Send the whole edit log: this client has noticed that its own is not the one that a change was made to. Answered by `state`. */
export interface LogMessage {
  type: "log";
}

export interface MasksRequest {
  /** At least one over the object and one over what is not. */
  strokes: Stroke[];
}

export interface MaterialEdit {
  op: "material";
  select: Selection;
  set: MaterialValues;
  mode?: "absolute" | "multiply";
}

/** Absolute: the new values, 0..1. Multiply: factors. */
export interface MaterialValues {
  albedo?: [number, number, number] | null;
  roughness?: number | null;
  metallic?: number | null;
}

/** What the object may be made of, by a name. */
export interface MaterialVariant {
  name: string;
  edits: MaterialEdit[];
}

/** What simulations of the object begin with, for the viewers of a session. It moves nothing by itself. */
export interface MatterEdit {
  op: "matter";
  scene: Record<string, unknown>;
}

/** What lies under a pixel of the newest frame. */
export interface PickMessage {
  type: "pick";
  id: number;
  /** Share of the width from the left. */
  x: number;
  /** Share of the height from the top. */
  y: number;
}

export interface PickedMessage {
  type: "picked";
  id: number;
  hit: boolean;
  /** World units. */
  position: [number, number, number] | null;
  normal: [number, number, number] | null;
  albedo: [number, number, number] | null;
  roughness: number | null;
  metallic: number | null;
  /** What a selection's `region` says for the patch of material here. */
  region?: number | null;
  /** The mesh's nearest vertex, where it is on the object at rest [world units]: what selections and grips refer to. */
  rest?: [number, number, number] | null;
}

export interface PoseEdit {
  op: "pose";
  clip: string;
  time: number;
  rig?: RigBinding | null;
}

/** Find where plain photographs, or the frames of a film, were taken from: a new capture, with the job's id, of those that found their place. */
export interface PoseRequest {
  /** Shown in lists. */
  name?: string | null;
  /** Lower runs first; jobs of one priority run in the order in which they came. */
  priority?: number;
  limits?: JobLimits;
  kind: "pose";
  /** As of a build. */
  dataset: string;
  seed?: number;
}

/** RFC 9457 problem details; `detail` is a sentence a user can act on. */
export interface Problem {
  type: string;
  title: string;
  status: number;
  detail: string;
}

/** Separate material and light of a built asset again, on its geometry, with the effort of another preset: a new asset. */
export interface RedecoupleRequest {
  /** Shown in lists. */
  name?: string | null;
  /** Lower runs first; jobs of one priority run in the order in which they came. */
  priority?: number;
  limits?: JobLimits;
  kind: "redecouple";
  asset: string;
  preset?: "draft" | "fast" | "full";
}

export interface RedoMessage {
  type: "redo";
  id: number;
  /** As of an edit. */
  key?: string | null;
}

export interface RejectedMessage {
  type: "rejected";
  id: number;
  reason: string;
  /** The log was changed by somebody else meanwhile: count anew and send again. */
  overtaken: boolean;
}

export interface RenderCamera {
  /** Of the picture. */
  name: string;
  /** OpenGL camera-to-world, rows. */
  world_from_camera: [[number, number, number, number], [number, number, number, number], [number, number, number, number], [number, number, number, number]];
  fov_y_degrees?: number;
}

/** Pictures of every variant under every environment from every camera, named variant-environment-camera.png. */
export interface RenderRequest {
  /** Shown in lists. */
  name?: string | null;
  /** Lower runs first; jobs of one priority run in the order in which they came. */
  priority?: number;
  limits?: JobLimits;
  kind: "render";
  asset: string;
  cameras?: RenderCamera[];
  /** Instead of cameras; with neither, one picture from the start view. */
  turntable?: Turntable | null;
  /** Instead of cameras: a picture every 1 / video_fps (or 1 / 24) seconds. */
  path?: CameraPath | null;
  /** Stored environments, `own` for the asset's; none: the light that the variants' edits say. */
  environments?: string[];
  /** None: the asset as it is. */
  variants?: RenderVariant[];
  /** Of a simulate job: camera k shows its moment k / video_fps (or / 24). */
  clip?: string | null;
  width?: number;
  height?: number;
  spp?: number;
  bounces?: number;
  exposure_stops?: number;
  denoise?: boolean;
  tone_curve?: "standard" | "filmic" | "agx" | "neutral";
  background?: "environment" | "blurred" | "transparent";
  /** Also join the pictures of each variant and environment, in the order of the cameras, to an MP4 (H.264). */
  video_fps?: number | null;
}

/** The asset under some edits; environment edits in it are kept where the request's environments do not replace them. */
export interface RenderVariant {
  name: string;
  edits?: Edit[];
}

/** How a glTF rig, turned to z up and world units, is laid over the object at rest, and how the object follows it. */
export interface RigBinding {
  turn?: [number, number, number];
  fit?: boolean;
  scale?: number;
  translation?: [number, number, number];
  method?: "auto" | "closest" | "mls";
  rest?: number | null;
  loop?: boolean;
}

export interface SaveRequest {
  /** Of the new version; the asset's name when absent. */
  name?: string | null;
}

/** Exactly one field is set. */
export interface Selection {
  all?: boolean | null;
  sphere?: Sphere | null;
  box?: Box | null;
  region?: number | null;
  similar?: Similar | null;
  vertex_weights?: number[] | null;
  weights_file?: string | null;
}

/** Answer to `hello`, sent once the asset is loaded. */
export interface ServerHello {
  type: "hello";
  v: number;
  /** Version of drgs. */
  server: string;
  session: string;
  asset: string;
  /** Bounds of the object at rest [world units]. */
  minimum: [number, number, number];
  maximum: [number, number, number];
  start_view: StartView;
  /**
   * Rows of the rotation of the first photograph's camera (world from camera, OpenGL), where the asset's own light stood still with the
   * camera of the photographs, as on a turntable: its table is as that camera saw it. null: it stands still with the object.
   */
  light_camera?: [[number, number, number], [number, number, number], [number, number, number]] | null;
  log: EditLog;
  /** Those in force until the client sends its own. */
  settings: Settings;
  max_in_flight: number;
}

export interface SessionInfo {
  id: string;
  asset: string;
  asset_name: string;
  created_at: string;
  revision: number;
  edits: Edit[];
  can_undo: boolean;
  can_redo: boolean;
  appended: number;
  /** This, `appended` and `broken` as in EditLog. */
  undone: Edit[];
  broken: BrokenEdit[];
  viewers: number;
}

export interface SessionList {
  sessions: SessionInfo[];
}

export interface SessionRequest {
  asset: string;
}

/** How this viewer sees the session; each viewer has its own. */
export interface Settings {
  exposure_stops?: number;
  /** From exposed light to the screen: standard clips, filmic and agx roll highlights off, neutral keeps base colours. */
  tone_curve?: "standard" | "filmic" | "agx" | "neutral";
  /** blurred: the environment out of focus, its light as sharp as ever. A triple is a colour, sRGB 0..1. Transparent arrives as PNG with alpha once converged and over grey while JPEG. */
  background?: "environment" | "blurred" | "transparent" | [number, number, number];
  /** Rays a pixel at which the picture counts as converged. */
  spp_target?: number;
  /** Indirect bounces; 0 is direct light with shadows only. */
  bounces?: number;
  channel?: "final" | "albedo" | "roughness" | "metallic" | "normal" | "depth" | "visibility" | "indirect" | "variance" | "surfels" | "certainty";
  /** Filter what is left of the noise; the filter follows the measured variance, so it fades as samples add up. */
  denoise?: boolean;
  /**
   * The asset's own light turns with this viewer's camera, where it stood still with the camera of the photographs (light_camera of hello). Any other
   * light stands still with the object.
   */
  turn_light?: boolean;
}

export interface SettingsMessage {
  type: "settings";
  settings: Settings;
}

/** Where the tiles of a capture's sheet lie, so that a page can show them in rows of its own. Lengths are shares of the sheet's width or height. */
export interface SheetLayout {
  /** Of tiles. */
  count: number;
  columns: number;
  /** Of the first tile. */
  left: number;
  top: number;
  /** From one tile to the next in its row. */
  across: number;
  /** From one row to the next; a tile with its label is as high. */
  down: number;
  /** Of a tile. */
  width: number;
  /** A tile's width over its height. */
  aspect: number;
}

export interface Similar {
  point: [number, number, number];
  tolerance?: number;
}

export interface SimulateEdit {
  op: "simulate";
  scene: Record<string, unknown>;
  time: number;
}

/** Move an asset's matter; the clip is played by `pose` edits that name it, and by batch renders. */
export interface SimulateRequest {
  /** Shown in lists. */
  name?: string | null;
  /** Lower runs first; jobs of one priority run in the order in which they came. */
  priority?: number;
  limits?: JobLimits;
  kind: "simulate";
  asset: string;
  /** As in `drgs simulate --scene`; empty: a jelly under its own weight. */
  scene?: Record<string, unknown>;
}

export interface SkippedWork {
  what: string;
  why: string;
  /** Of the difference it makes. */
  bound: string;
}

export interface SnapshotInfo {
  name: string;
  created_at: string;
  /** Of the log when it was taken. */
  revision: number;
  edits: Edit[];
}

export interface SnapshotList {
  /** Oldest first. */
  snapshots: SnapshotInfo[];
}

export interface Sphere {
  center: [number, number, number];
  radius: number;
  falloff?: number;
}

/** Put edits in the place of some of those in force, as one step of undo. */
export interface SpliceMessage {
  type: "splice";
  id: number;
  /** Of the log that `start` and `remove` count in; once there is a newer one the answer is `rejected` with `overtaken`. */
  revision: number;
  /** How many edits stay in front. */
  start: number;
  /** How many behind them go. */
  remove: number;
  /** What comes in their place. */
  edits: Edit[];
  /** As of an edit: a splice with the key of the one just before it is the same step of undo. */
  coalesce?: string | null;
  /** As of an edit. */
  key?: string | null;
}

/** A camera that shows the whole object, for the first picture. */
export interface StartView {
  world_from_camera: [[number, number, number, number], [number, number, number, number], [number, number, number, number], [number, number, number, number]];
  fov_y_degrees: number;
}

/**
 * The whole edit log: sent to viewers that did not ask for `changes`, after a change of it, and to others when they ask, or where
 * they were too slow for changes. One that is overtaken before it was sent is left out.
 */
export interface StateMessage {
  type: "state";
  log: EditLog;
}

/** For the corner of the picture; sent when the phase changes and with each frame, at most 5 a second. */
export interface StatusMessage {
  type: "status";
  phase: "loading" | "moving" | "still" | "converged" | "paused";
  /** Of the pictures sent now. */
  width: number;
  height: number;
  /** Share of the asked-for width; 1 unless moving. */
  scale: number;
  spp: number;
  spp_target: number;
  frames_per_second: number;
  render_ms: number;
  /** What was skipped or reduced, and why. */
  notes: string[];
}

export interface StretchMap {
  type: "stretch";
  factor: number;
}

/** A way over a picture, as the build sees it: upright, and without lens distortion. */
export interface Stroke {
  /** Name of its file, without its ending. */
  picture: string;
  shows: "object" | "background";
  /** Half its width, as a share of the picture's longer side. */
  radius?: number;
  /** x to the right and y down, as shares of the picture's width and height; joined by straight lines. */
  points: [number, number][];
}

export interface TokenRequest {
  token: string;
}

/** One camera of the capture that an asset was built from. */
export interface TrainingView {
  /** Of the photograph's file, without its ending. */
  name: string;
  /** Pixels of the photograph as the build saw it. */
  width: number;
  height: number;
  /** OpenGL camera-to-world, rows, as of a camera message. */
  world_from_camera: [[number, number, number, number], [number, number, number, number], [number, number, number, number], [number, number, number, number]];
  /**
   * This and the next three: edges of the picture on the plane at distance 1 before the camera, x to the right and y up. The picture's
   * middle need not lie on the axis.
   */
  left: number;
  right: number;
  bottom: number;
  top: number;
}

export interface TrainingViewList {
  /** In the order of the asset's cameras; empty for an imported mesh. */
  views: TrainingView[];
  /** False for assets that were built before photographs were kept with them. */
  has_photographs: boolean;
}

/** Cameras round the object, all of it in sight. */
export interface Turntable {
  frames?: number;
  elevation_degrees?: number;
  turns?: number;
}

export interface TwistMap {
  type: "twist";
  rate: number;
}

export interface UndoMessage {
  type: "undo";
  id: number;
  /** As of an edit. */
  key?: string | null;
}

/** Stands where an edit was kept that this version does not read, so that those around it keep their places. It never applies. */
export interface UnreadableEdit {
  op: "unreadable";
  found: string;
}

/** Keeps a variant with the session. It changes nothing by itself; of two with one name the later counts. */
export interface VariantEdit {
  name: string;
  edits: MaterialEdit[];
  op: "variant";
}

/** A hidden page gets no frames. */
export interface VisibilityMessage {
  type: "visibility";
  visible: boolean;
}

export interface WeightsInfo {
  /** What a selection's `weights_file` says. */
  file: string;
  vertices: number;
}

export type ClientMessage =
  | ClientHello
  | CameraMessage
  | EditMessage
  | SpliceMessage
  | UndoMessage
  | RedoMessage
  | AckMessage
  | SettingsMessage
  | VisibilityMessage
  | PickMessage
  | ExplainMessage
  | LogMessage
  | CancelMessage;

export type ServerMessage =
  | ServerHello
  | StateMessage
  | LogChangeMessage
  | AcceptedMessage
  | RejectedMessage
  | StatusMessage
  | PickedMessage
  | ExplainedMessage
  | ErrorMessage;

export type Edit =
  | MaterialEdit
  | EnvironmentEdit
  | DeformEdit
  | PoseEdit
  | SimulateEdit
  | MatterEdit
  | VariantEdit
  | UnreadableEdit;
