/**
 * One WebSocket to a session: JSON text both ways, pictures as binary (docs/protocol.md).
 *
 * Of cameras and settings only the newest counts; they are sent at most every CAMERA_INTERVAL_MS. Edits, undo and redo are ordered: they
 * wait in `outbox` until the server has accepted or rejected them, and are sent again after a reconnection. Their keys keep the server
 * from applying one twice.
 */

import { CAMERA_NUMBER_SHIFT, CLOSE_VERSION_MISMATCH, FRAME_HEADER_BYTES, PROTOCOL_VERSION, readFrameHeader, type CameraMessage, type ClientMessage, type Edit, type EditMessage, type FrameHeader, type PickedMessage, type RedoMessage, type ServerHello, type ServerMessage, type Settings, type SpliceMessage, type UndoMessage } from './protocol.gen';

const CAMERA_INTERVAL_MS = 25;
const RECONNECT_FIRST_MS = 200;
const RECONNECT_LONGEST_MS = 400;

/** The server takes no message of this size: sent again, it would end the next connection, too. */
const CLOSE_TOO_BIG = 1009;

export type Connection = 'connecting' | 'open' | 'lost' | 'closed';
type Ordered = EditMessage | SpliceMessage | UndoMessage | RedoMessage;

export interface StreamEvents {
  connection(state: Connection): void;
  hello(message: ServerHello): void;
  message(message: Exclude<ServerMessage, ServerHello | PickedMessage>): void;
  /** So many changes are sent and not answered; said after each that is sent, answered or dropped. */
  waiting(count: number): void;
  /** The decoded picture; the receiver closes it. `cameraNumber`: low 8 bits of the number of the camera that it shows. */
  frame(header: FrameHeader, picture: ImageBitmap, cameraNumber: number): void;
  /** The server will not take this client back; `reason` is for the user. */
  refused(reason: string): void;
  /** The connection dropped: ask whether the session still exists, and under which id. Null: keep trying the same one. */
  lost(): Promise<string | null>;
}

export class Stream {
  private socket: WebSocket | null = null;
  private ready = false;
  private closed = false;
  private retryMs = RECONNECT_FIRST_MS;
  private nextId = 1;
  private outbox: Ordered[] = [];
  private camera: CameraMessage | null = null;
  private cameraNumber = 0;
  private pose = '';
  private settings: Settings | null = null;
  private viewSentAt = 0;
  private viewTimer = 0;
  private settingsSent = false;
  private picks = new Map<number, (picked: PickedMessage) => void>();
  private newestFrame = 0;
  private holding = false;
  /** The newest frame that the server was not told of, while holding. */
  private unacknowledged = 0;
  /** Begins the keys of this page's changes. */
  private readonly page = crypto.getRandomValues(new Uint32Array(2)).join('-');

  constructor(
    private session: string,
    private readonly events: StreamEvents,
  ) {
    this.connect();
    document.addEventListener('visibilitychange', this.onVisibility);
  }

  close(): void {
    this.closed = true;
    document.removeEventListener('visibilitychange', this.onVisibility);
    this.socket?.close();
    this.events.connection('closed');
  }

  /** Low 8 bits of the number by which frames will name this camera with the newest settings. The same camera keeps its number. */
  sendCamera(camera: Omit<CameraMessage, 'type' | 'number'>): number {
    const pose = JSON.stringify(camera);
    if (pose === this.pose) return this.cameraNumber & 0xff;
    this.pose = pose;
    this.cameraNumber = (this.cameraNumber + 1) >>> 0;
    this.camera = { type: 'camera', number: this.cameraNumber, ...camera };
    this.flushSoon();
    return this.cameraNumber & 0xff;
  }

  /** The camera gets a new number: frames that carry it show these settings. */
  sendSettings(settings: Settings): void {
    this.settings = settings;
    this.settingsSent = false;
    this.cameraNumber = (this.cameraNumber + 1) >>> 0;
    if (this.camera) this.camera = { ...this.camera, number: this.cameraNumber };
    this.flushSoon();
  }

  /** The id that `accepted` or `rejected` will repeat. */
  sendEdit(edit: Edit, coalesce: string | null): number {
    const id = this.nextId++;
    // Edits of a drag have no key: the server may skip all but the last, and setting a value twice does no harm.
    return this.order({ type: 'edit', id, edit, coalesce, key: coalesce === null ? this.key(id) : null });
  }

  /** Splice the log of this revision: behind its first `start` edits, `edits` take the place of `remove`. */
  splice(revision: number, start: number, remove: number, edits: Edit[], coalesce: string | null): number {
    const id = this.nextId++;
    return this.order({ type: 'splice', id, revision, start, remove, edits, coalesce, key: this.key(id) });
  }

  undo(): number {
    const id = this.nextId++;
    return this.order({ type: 'undo', id, key: this.key(id) });
  }

  redo(): number {
    const id = this.nextId++;
    return this.order({ type: 'redo', id, key: this.key(id) });
  }

  private key = (id: number) => `${this.page}-${id}`;

  /** Whether the server has answered all changes of the log. */
  get idle(): boolean {
    return this.ready && this.outbox.length === 0;
  }

  /** Whether an undo or a redo is on its way: the other one, which it makes possible, may be asked for already. */
  awaits(type: 'undo' | 'redo'): boolean {
    return this.outbox.some((waiting) => waiting.type === type);
  }

  /** What lies under a point of the picture, as shares of its width and height. */
  pick(x: number, y: number): Promise<PickedMessage> {
    const id = this.nextId++;
    return new Promise((resolve) => {
      if (!this.ready) return resolve({ type: 'picked', id, hit: false, position: null, normal: null, albedo: null, roughness: null, metallic: null });
      this.picks.set(id, resolve);
      this.send({ type: 'pick', id, x, y });
    });
  }

  /** Ask for the whole log, since a change was made to another one than this page has. */
  askForLog(): void {
    this.send({ type: 'log' });
  }

  /** Have the server give up the change that it is computing, such as a long simulation; it is then rejected. */
  cancelChange(): void {
    this.send({ type: 'cancel' });
  }

  private order(message: Ordered): number {
    this.outbox.push(message);
    this.events.waiting(this.outbox.length);
    if (this.ready) this.send(message);
    return message.id;
  }

  private send(message: ClientMessage): void {
    if (this.socket?.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(message));
  }

  private flushSoon(): void {
    if (!this.viewTimer) this.viewTimer = window.setTimeout(this.flushView, Math.max(0, this.viewSentAt + CAMERA_INTERVAL_MS - performance.now()));
  }

  private flushView = () => {
    this.viewTimer = 0;
    if (!this.ready) return;
    this.viewSentAt = performance.now();
    if (this.settings && !this.settingsSent) this.send({ type: 'settings', settings: this.settings });
    this.settingsSent = true;
    if (this.camera) this.send(this.camera);
  };

  private onVisibility = () => {
    if (this.ready) this.send({ type: 'visibility', visible: !document.hidden });
  };

  private connect(): void {
    this.events.connection('connecting');
    const scheme = location.protocol === 'https:' ? 'wss' : 'ws';
    const socket = new WebSocket(`${scheme}://${location.host}/api/sessions/${this.session}/stream`);
    socket.binaryType = 'arraybuffer';
    this.socket = socket;
    socket.onopen = () => this.send({ type: 'hello', v: PROTOCOL_VERSION, codecs: ['jpeg', 'png'], changes: true, client: 'viewer' });
    socket.onmessage = (event: MessageEvent<string | ArrayBuffer>) => {
      if (typeof event.data === 'string') this.receive(JSON.parse(event.data) as ServerMessage);
      else void this.receiveFrame(event.data);
    };
    socket.onclose = (event) => void this.dropped(socket, event);
  }

  private receive(message: ServerMessage): void {
    switch (message.type) {
      case 'hello':
        this.ready = true;
        this.retryMs = RECONNECT_FIRST_MS;
        this.newestFrame = this.unacknowledged = 0;
        this.events.hello(message);
        this.events.connection('open');
        this.settingsSent = false;
        this.flushView();
        if (document.hidden) this.onVisibility();
        for (const waiting of this.outbox) this.send(waiting);
        return;
      case 'status':
        // The server is there again, and loading the asset.
        if (!this.ready) this.events.connection('open');
        break;
      case 'picked':
        this.picks.get(message.id)?.(message);
        this.picks.delete(message.id);
        return;
      case 'accepted':
      case 'rejected':
        this.outbox = this.outbox.filter((waiting) => waiting.id !== message.id);
        this.events.waiting(this.outbox.length);
        break;
      case 'error':
        if (message.fatal) {
          this.closed = true;
          this.events.refused(message.message);
        }
        break;
    }
    this.events.message(message);
  }

  private async receiveFrame(data: ArrayBuffer): Promise<void> {
    if (data.byteLength <= FRAME_HEADER_BYTES) return;
    const header = readFrameHeader(data);
    const socket = this.socket;
    const picture = await createImageBitmap(new Blob([new Uint8Array(data, FRAME_HEADER_BYTES)])).catch(() => null);
    if (socket !== this.socket) return picture?.close();
    // Decoding may finish out of order; an older picture must not replace a newer one.
    if (picture && header.frameId > this.newestFrame) {
      this.newestFrame = header.frameId;
      this.events.frame(header, picture, header.flags >> CAMERA_NUMBER_SHIFT);
    } else picture?.close();
    this.unacknowledged = Math.max(this.unacknowledged, header.frameId);
    this.acknowledge();
  }

  private acknowledge(): void {
    if (this.holding || !this.unacknowledged) return;
    this.send({ type: 'ack', frame_id: this.unacknowledged });
    this.unacknowledged = 0;
  }

  /** While true, nobody sees the server's pictures: it is left to rest once those in flight have come, since none of them is acknowledged. */
  holdFrames(hold: boolean): void {
    if (hold === this.holding) return;
    this.holding = hold;
    this.acknowledge();
  }

  /** Answer the largest change that waits as the server would, if it could. */
  private giveUpLargest(): void {
    const sizes = this.outbox.map((waiting) => JSON.stringify(waiting).length);
    const largest = this.outbox[sizes.indexOf(Math.max(...sizes))];
    if (!largest) return;
    this.outbox = this.outbox.filter((waiting) => waiting !== largest);
    this.events.waiting(this.outbox.length);
    this.events.message({ type: 'rejected', id: largest.id, reason: 'This change is larger than the server takes; nothing was changed.', overtaken: false });
  }

  private async dropped(socket: WebSocket, event: CloseEvent): Promise<void> {
    if (socket !== this.socket) return;
    this.ready = false;
    for (const [id, resolve] of this.picks) resolve({ type: 'picked', id, hit: false, position: null, normal: null, albedo: null, roughness: null, metallic: null });
    this.picks.clear();
    if (this.closed) return;
    if (event.code === CLOSE_VERSION_MISMATCH) {
      this.closed = true;
      this.events.refused(event.reason || 'This page is older or newer than the server. Reload the page.');
      return;
    }
    if (event.code === CLOSE_TOO_BIG) this.giveUpLargest();
    this.events.connection('lost');
    const wait = this.retryMs;
    this.retryMs = Math.min(RECONNECT_LONGEST_MS, this.retryMs * 2);
    await new Promise((resolve) => setTimeout(resolve, wait));
    const session = await this.events.lost();
    if (this.closed) return;
    if (session && session !== this.session) {
      this.session = session;
      this.outbox = []; // the new session was given the whole log
      this.events.waiting(0);
    }
    this.connect();
  }
}
