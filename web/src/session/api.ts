/** The REST calls of the viewer, each once. Every failure is an ApiError whose message is a sentence for the user. */

import { STILL_BOUNCES, type DownloadFormat } from './constants.gen';
import type { AssetInfo, AssetList, BuildRequest, CaptureInfo, CaptureList, CaptureLook, CaptureMasks, Edit, EnvironmentInfo, EnvironmentList, JobFileList, JobInfo, JobList, PoseRequest, Problem, RenderRequest, SessionInfo, SessionList, Settings, SimulateRequest, Stroke, TrainingViewList, WeightsInfo } from './protocol.gen';
import type { View } from './view';

export class ApiError extends Error {
  constructor(
    readonly status: number,
    message: string,
  ) {
    super(message);
  }
}

const UNREACHABLE = 'The server does not answer. Check that `drgs serve` is still running.';

function sentenceFor(status: number, body: string): string {
  try {
    const problem = JSON.parse(body) as Partial<Problem>;
    if (typeof problem.detail === 'string' && problem.detail) return problem.detail;
  } catch {
    // not a problem document: fall through to the status
  }
  if (status === 401 || status === 403) return 'This page is not signed in. Open the link with the token that `drgs serve` printed.';
  if (status === 404) return 'The server no longer has that.';
  if (status === 413) return 'That file is larger than the server accepts.';
  return `The server answered with error ${status}. Its log says more.`;
}

/** Settles when the link's token has become a cookie; all other calls wait for it. */
let signedIn: Promise<unknown> = Promise.resolve();

async function call<T>(method: string, path: string, body?: unknown, leaving?: AbortSignal): Promise<T> {
  await signedIn;
  return ask(method, path, body, leaving);
}

async function ask<T>(method: string, path: string, body?: unknown, leaving?: AbortSignal): Promise<T> {
  let response: Response;
  try {
    response = await fetch(path, {
      method,
      signal: leaving,
      headers: body === undefined ? undefined : { 'Content-Type': 'application/json' },
      body: body === undefined ? undefined : JSON.stringify(body),
    });
  } catch {
    throw new ApiError(0, UNREACHABLE);
  }
  const text = await response.text();
  if (!response.ok) throw new ApiError(response.status, sentenceFor(response.status, text));
  return (text ? JSON.parse(text) : undefined) as T;
}

/** Send a form by XMLHttpRequest, which unlike fetch tells how far an upload is (0..1). */
async function upload<T>(path: string, form: FormData, onProgress?: (share: number) => void): Promise<T> {
  await signedIn;
  return new Promise((resolve, reject) => {
    const request = new XMLHttpRequest();
    request.open('POST', path);
    request.upload.onprogress = (event) => event.lengthComputable && onProgress?.(event.loaded / event.total);
    request.onload = () => {
      if (request.status >= 200 && request.status < 300) resolve(JSON.parse(request.responseText) as T);
      else reject(new ApiError(request.status, sentenceFor(request.status, request.responseText)));
    };
    request.onerror = () => reject(new ApiError(0, UNREACHABLE));
    request.send(form);
  });
}

const part = encodeURIComponent;

export function login(token: string): Promise<void> {
  const answer = ask<void>('POST', '/api/login', { token });
  signedIn = answer.catch(() => {}); // the caller tells the user
  return answer;
}

export const listAssets = () => call<AssetList>('GET', '/api/assets');
export const assetThumb = (asset: AssetInfo) => `/api/assets/${part(asset.id)}/thumb.jpg`;
export const assetMesh = (id: string) => `/api/assets/${part(id)}/mesh.glb`;
export const assetEnvironment = (id: string) => `/api/assets/${part(id)}/environment.exr`;
/** `faces`: the most that a textured mesh has; null where the server knows, or the format has none. */
export const assetExport = (id: string, format: DownloadFormat, faces: number | null) => `/api/assets/${part(id)}/export?${exportQuery(format, faces)}`;
/** The same with the session's edits put into it. */
export const sessionExport = (id: string, format: DownloadFormat, faces: number | null) => `/api/sessions/${part(id)}/export?${exportQuery(format, faces)}`;
const exportQuery = (format: DownloadFormat, faces: number | null) => `format=${format}${faces === null ? '' : `&faces=${faces}`}`;
export const listTrainingViews = (asset: string) => call<TrainingViewList>('GET', `/api/assets/${part(asset)}/views`);
export const photograph = (asset: string, view: number) => `/api/assets/${part(asset)}/views/${view}/photograph.webp`;

export function uploadAsset(file: File, onProgress?: (share: number) => void): Promise<AssetInfo> {
  const form = new FormData();
  form.append('file', file);
  return upload('/api/assets', form, onProgress);
}

export const listEnvironments = () => call<EnvironmentList>('GET', '/api/environments');
export const environmentThumb = (name: string) => `/api/environments/${part(name)}/thumb.jpg`;
export const environmentFile = (name: string) => `/api/environments/${part(name)}`;

export function uploadEnvironment(file: File, onProgress?: (share: number) => void): Promise<EnvironmentInfo> {
  const form = new FormData();
  form.append('file', file);
  return upload('/api/environments', form, onProgress);
}

export const makeCapture = (upload: string) => call<CaptureInfo>('POST', '/api/captures', { upload });
export const listCaptures = () => call<CaptureList>('GET', '/api/captures');
export const readCapture = (id: string) => call<CaptureInfo>('GET', `/api/captures/${part(id)}`);
export const deleteCapture = (id: string) => call<void>('DELETE', `/api/captures/${part(id)}`);
/** Takes seconds to minutes when it is asked for the first time. */
export const lookAtCapture = (id: string) => call<CaptureLook>('GET', `/api/captures/${part(id)}/look`);
/** Of the look's camera of that number, as a build sees it. */
export const capturePicture = (id: string, number: number) => `/api/captures/${part(id)}/pictures/${number}.jpg`;
/** Takes seconds to a minute; it ends when the page leaves. */
export const findMasks = (id: string, strokes: Stroke[], leaving: AbortSignal) => call<CaptureMasks>('POST', `/api/captures/${part(id)}/masks`, { strokes }, leaving);
export const masksSheet = (id: string, version: string) => `/api/captures/${part(id)}/masks/${version}.jpg`;
export const captureSheet = (id: string) => `/api/captures/${part(id)}/sheet.jpg`;

const TUS = { 'Tus-Resumable': '1.0.0' };

async function tus(method: 'POST' | 'HEAD' | 'DELETE', path: string, headers: Record<string, string>): Promise<Headers> {
  await signedIn;
  const response = await fetch(path, { method, headers: { ...TUS, ...headers } }).catch(() => {
    throw new ApiError(0, UNREACHABLE);
  });
  if (!response.ok) throw new ApiError(response.status, sentenceFor(response.status, await response.text()));
  return response.headers;
}

/** Announce an upload in parts; where its parts go. */
export async function announceUpload(name: string, bytes: number): Promise<string> {
  const filename = btoa(String.fromCharCode(...new TextEncoder().encode(name)));
  return (await tus('POST', '/api/uploads', { 'Upload-Length': String(bytes), 'Upload-Metadata': `filename ${filename}` })).get('Location')!;
}

/** Bytes of an upload that have arrived. */
export const uploadOffset = async (address: string) => Number((await tus('HEAD', address, {})).get('Upload-Offset'));
export const deleteUpload = (address: string) => tus('DELETE', address, {});

/** Send bytes that begin at `offset`; how many have arrived then. `onSent`: of this part. */
export async function sendPart(address: string, offset: number, bytes: Blob, onSent: (bytes: number) => void, leaving: AbortSignal): Promise<number> {
  await signedIn;
  return new Promise((resolve, reject) => {
    const request = new XMLHttpRequest();
    request.open('PATCH', address);
    for (const [name, value] of Object.entries({ ...TUS, 'Upload-Offset': String(offset), 'Content-Type': 'application/offset+octet-stream' })) request.setRequestHeader(name, value);
    const leave = () => request.abort();
    leaving.addEventListener('abort', leave);
    request.upload.onprogress = (event) => onSent(event.loaded);
    request.onloadend = () => {
      leaving.removeEventListener('abort', leave);
      if (request.status === 204) resolve(Number(request.getResponseHeader('Upload-Offset')));
      else reject(leaving.aborted ? new DOMException('The upload was cancelled.', 'AbortError') : new ApiError(request.status, request.status ? sentenceFor(request.status, request.responseText) : UNREACHABLE));
    };
    request.send(bytes);
  });
}

export const listJobs = () => call<JobList>('GET', '/api/jobs');
export const startJob = (request: BuildRequest | PoseRequest | RenderRequest | SimulateRequest) => call<JobInfo>('POST', '/api/jobs', request);
export const cancelJob = (id: string) => call<JobInfo>('POST', `/api/jobs/${part(id)}/cancel`);
export const resumeJob = (id: string) => call<JobInfo>('POST', `/api/jobs/${part(id)}/resume`);
export const retryJob = (id: string) => call<JobInfo>('POST', `/api/jobs/${part(id)}/retry`);
export const deleteJob = (id: string) => call<void>('DELETE', `/api/jobs/${part(id)}`);
export const jobFiles = (id: string) => call<JobFileList>('GET', `/api/jobs/${part(id)}/files`);
export const jobFile = (id: string, name: string) => `/api/jobs/${part(id)}/files/${part(name)}`;
export const jobPreview = (job: JobInfo) => `/api/jobs/${part(job.id)}/preview.jpg?v=${job.preview_version}`;

export async function uploadWeights(weights: ArrayLike<number>): Promise<WeightsInfo> {
  await signedIn;
  const response = await fetch('/api/weights', { method: 'POST', headers: { 'Content-Type': 'application/octet-stream' }, body: Float32Array.from(weights) }).catch(() => {
    throw new ApiError(0, UNREACHABLE);
  });
  if (!response.ok) throw new ApiError(response.status, sentenceFor(response.status, await response.text()));
  return (await response.json()) as WeightsInfo;
}

/** `address`: what a selection's `weights_file` says. */
export const getWeights = async (address: string) => new Float32Array(await (await file(`/api/${address.split('/').map(part).join('/')}`)).arrayBuffer());

export const listSessions = () => call<SessionList>('GET', '/api/sessions');
export const openSession = (asset: string) => call<SessionInfo>('POST', '/api/sessions', { asset });
export const getSession = (id: string) => call<SessionInfo>('GET', `/api/sessions/${part(id)}`);
/** A new version of the asset with the session's edits put into it. */
export const saveVersion = (session: string) => call<AssetInfo>('POST', `/api/sessions/${part(session)}/save`);
export const appendEdit = (session: string, edit: Edit) => call<unknown>('POST', `/api/sessions/${part(session)}/edits`, { edit });

/** Of pictures that are waited for: moving ones have one, which is left to them; another choice is the user's own. */
export const stillBounces = (settings: Pick<Settings, 'bounces'>) => (settings.bounces === 1 ? STILL_BOUNCES : settings.bounces);

/** `all`: every channel as a layer of one EXR. */
export type StillSettings = Omit<Settings, 'channel'> & { channel?: Settings['channel'] | 'all' };

/** Query of `frame.png` and its like for a camera. A background colour can only be streamed. */
export function frameQuery(view: View, { width, height }: { width: number; height: number }, settings: StillSettings, transparent: boolean): string {
  const query = new URLSearchParams({
    width: String(width),
    height: String(height),
    spp: String(settings.spp_target),
    bounces: String(stillBounces(settings)),
    exposure_stops: String(settings.exposure_stops),
    tone_curve: settings.tone_curve ?? 'standard',
    channel: settings.channel ?? 'final',
    denoise: String(settings.denoise),
    turn_light: String(settings.turn_light ?? false),
    background: transparent ? 'transparent' : settings.background === 'blurred' ? 'blurred' : 'environment',
    fov_y_degrees: String(view.fov_y_degrees),
    world_from_camera: view.world_from_camera.flat().join(','),
  });
  return query.toString();
}

/** Where the session's edits put the vertices of the asset's mesh, three numbers each [world units]. */
export const sessionVertices = async (session: string) => new Float32Array(await (await file(`/api/sessions/${part(session)}/vertices`)).arrayBuffer());

/** A picture of the object with material and shape as captured, under the present light. */
export const capturedPicture = async (session: string, query: string) => (await file(`/api/sessions/${part(session)}/frame.jpg?${query}&captured=true`)).blob();

export type StillFormat = 'png' | 'exr';
/** What `environment` of a picture calls the asset's own light. */
export const CAPTURED_LIGHT = 'captured';

export const stillPicture = async (session: string, query: string, format: StillFormat, leaving: AbortSignal) => (await file(`/api/sessions/${part(session)}/frame.${format}?${query}`, leaving)).blob();

/** A file that the server writes on request, with the name that it gives it; it stops when the page leaves. */
export async function exportedFile(address: string, leaving: AbortSignal): Promise<{ content: Blob; name: string }> {
  const response = await file(address, leaving);
  const said = response.headers.get('Content-Disposition') ?? '';
  const name = /filename\*=utf-8''([^;]+)/i.exec(said)?.[1] ?? /filename="([^"]+)"/.exec(said)?.[1] ?? 'asset';
  return { content: await response.blob(), name: decodeURIComponent(name) };
}

async function file(address: string, leaving?: AbortSignal): Promise<Response> {
  const response = await fetch(address, { signal: leaving }).catch((error: unknown) => {
    throw leaving?.aborted ? error : new ApiError(0, UNREACHABLE);
  });
  if (!response.ok) throw new ApiError(response.status, sentenceFor(response.status, await response.text()));
  return response;
}
