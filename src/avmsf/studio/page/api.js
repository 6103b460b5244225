/** All that the page fetches: the files of its field, and what it asks of the studio's server. */

import { Contacts } from "./contacts.js";

const FORMAT = 1;
const ARRAYS = { float64: Float64Array, float32: Float32Array };
const GONE =
  "The server does not answer. Check that it runs and try again; nothing is lost. A restarted `avmsf studio` prints " +
  "a new address: open it.";
/** What only the last message of a job holds. */
const OUTCOMES = ["error", "field", "object", "revision"];

/** A request that was refused or not answered; `status` is 0 without an answer of the page's own server. */
export class RequestError extends Error {
  constructor(message, { status = 0, revision = null } = {}) {
    super(message);
    Object.assign(this, { status, revision });
    this.unreachable = status === 0;
    /** Whether the server has looked at what it was sent, and does not accept it. */
    this.refusal = status >= 400 && status < 500;
    /** Whether another tab was faster. */
    this.stale = status === 409 && revision !== null;
  }
}

/** What `read` makes of the response. Throws RequestError. */
async function request(method, address, { read, name = address, ...options }) {
  const response = await fetch(address, { method, cache: "no-cache", ...options }).catch(() => null);
  if (response === null) throw new RequestError(GONE);
  if (response.ok)
    // What cannot be read was cut on its way, and nobody knows what it said.
    return read(response).catch(() => {
      throw new RequestError(GONE);
    });
  const { error, moved, revision = null } = await response.json().catch(() => ({}));
  if (moved) throw new RequestError(error);
  const words = error ?? `${name} cannot be read (${response.status}): export the page again, or reload it`;
  throw new RequestError(words, { status: response.status, revision });
}

/** The address of one of the page's files, which a page that is one file carries in `avmsfInlined`. */
export function fileUrl(name) {
  const inlined = globalThis.avmsfInlined?.[name];
  return inlined ? `data:${inlined.type};base64,${inlined.base64}` : new URL(name, document.baseURI).href;
}

const readFile = (name) => request("GET", fileUrl(name), { name, read: (response) => response.arrayBuffer() });

/**
 * The field: {manifest, tensors, contacts, read(file)}; tensors by name (points, normals, frequency, damping, sine,
 * cosine, noise) as flat arrays, row by row; `read` gives the bytes of a file that the manifest names.
 */
export async function loadBundle() {
  const manifest = JSON.parse(new TextDecoder().decode(await readFile("manifest.json")));
  if (manifest.format !== FORMAT)
    throw new Error(`expected a field of format ${FORMAT}, got ${manifest.format}; export it again with this version`);
  const files = {};
  const tensors = {};
  for (const [name, { file, offset, dtype, shape }] of Object.entries(manifest.tensors)) {
    files[file] ??= await readFile(file);
    tensors[name] = readTensor(files[file], offset, dtype, shape, `${file}: ${name}`);
  }
  // Modes that all start as sines have no cosines to send.
  tensors.cosine ??= new Float32Array(tensors.sine.length);
  return { manifest, tensors, contacts: new Contacts(tensors), read: readFile };
}

function readTensor(buffer, offset, dtype, shape, what) {
  const count = shape.reduce((product, size) => product * size, 1);
  const kind = ARRAYS[dtype];
  if (kind === undefined) throw new Error(`${what} has the unknown type ${dtype}`);
  const end = offset + count * kind.BYTES_PER_ELEMENT;
  if (end > buffer.byteLength)
    throw new Error(`${what}: expected ${end} bytes, got ${buffer.byteLength}; export the page again`);
  const tensor = new kind(buffer, offset, count);
  const bad = tensor.findIndex((value) => !Number.isFinite(value));
  if (bad >= 0) throw new Error(`${what}: expected numbers, got ${tensor[bad]} at index ${bad}; export the page again`);
  return tensor;
}

/** Numbers that came as base64 of float32, little endian. */
export function numbers(text) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  return new Float32Array(bytes.buffer);
}

const ask = (method, place, options) => request(method, place, { read: (response) => response.json(), ...options });
const json = (content) => ({ body: JSON.stringify(content), headers: { "Content-Type": "application/json" } });
const wav = (body, headers = {}) => ({ body, headers: { "Content-Type": "audio/wav", ...headers } });
const ifMatch = (digest) => (digest ? { "If-Match": digest } : {});

/** The address of an impact's recording, whose file may lie in a folder of its own. */
export const recordingUrl = (file) => `capture/strikes/${file.split("/").map(encodeURIComponent).join("/")}`;

export const server = {
  /** Where the impacts of a recording fell. */
  locate: (recording) => ask("POST", "locate", wav(recording)),

  edit: (base, change) => ask("POST", "edit", json({ base, ...change })),
  guide: (base, recording) => ask("POST", `lead?base=${base}`, wav(recording)),
  undo: (base) => ask("POST", "undo", json({ base })),
  save: (base, name) => ask("POST", "save", json({ base, name })),

  capture: () => ask("GET", "capture"),
  checkRecording: (recording) => ask("POST", "capture/check", wav(recording)),

  /** Add an impact; the same recording and contact twice add it once. */
  addImpact: (recording, { contact, direction }) => {
    const [[x, y, z], [nx, ny, nz]] = [contact, direction ?? []];
    const query = new URLSearchParams({ x, y, z, ...(direction && { nx, ny, nz }) });
    return ask("POST", `capture/strikes?${query}`, wav(recording));
  },
  // With the recording's digest, as `capture` gives it, it is changed only if no other tab was faster.
  replaceRecording: (file, recording, { digest }) => ask("PUT", recordingUrl(file), wav(recording, ifMatch(digest))),
  removeImpact: ({ file, digest }) => ask("DELETE", recordingUrl(file), { headers: ifMatch(digest) }),

  reconstruct: () => ask("POST", "reconstruct"),
  makeObject: () => ask("POST", "object"),
  cancel: (job) => ask("DELETE", `jobs/${encodeURIComponent(job)}`),

  /** Call `take(message, ended)` with each of a job's messages, the last of which holds its result or "error". */
  follow(job, take) {
    const source = new EventSource(`jobs/${encodeURIComponent(job)}/events`);
    source.onmessage = (event) => {
      const message = JSON.parse(event.data);
      const ended = message.stage === "cancelled" || OUTCOMES.some((name) => name in message);
      if (ended) source.close();
      take(message, ended);
    };
    // The source tries again by itself while it is connecting; only a source that has given up is closed.
    source.onerror = () => {
      if (source.readyState === EventSource.CLOSED) take({ error: GONE }, true);
      else take({ words: "Connection lost; reconnecting …" }, false);
    };
  },
};
