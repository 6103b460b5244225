/** What the page asks of the server that it came from: one method for each thing the server does. */

/** The server said no, or did not answer: `status` is 0 then. */
export class ServerError extends Error {
  constructor(words, { status = 0, revision = null } = {}) {
    super(words);
    this.status = status;
    this.revision = revision;
  }

  /** Whether another tab was faster. */
  get stale() {
    return this.status === 409 && this.revision !== null;
  }

  /** Whether the server has looked at what it was sent, and will not have it. */
  get refusal() {
    return this.status >= 400 && this.status < 500;
  }

  /** Whether nobody was there to say anything. */
  get unreachable() {
    return this.status === 0;
  }
}

const GONE =
  "The server does not answer. Check that `avmsf studio` runs and try again; nothing is lost. A restarted studio " +
  "prints a new address: open it.";
/** What a server says to whoever does not know its present secret. */
const NOTHING = "there is nothing at this address";
const MOVED =
  "The studio is no longer at this page's address: a restarted studio prints a new address. " +
  "Open it.";

async function ask(method, place, { body, headers, signal } = {}) {
  let answer;
  try {
    answer = await fetch(place, { method, body, headers, signal, cache: "no-store" });
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new ServerError(GONE);
  }
  const text = await answer.text().catch(() => "");
  let content;
  try {
    content = JSON.parse(text);
  } catch {
    // The server says everything in JSON: what is none was cut on its way, and nobody knows what it said.
    if (answer.ok) throw new ServerError(GONE);
    content = null;
  }
  if (answer.ok) return content;
  if (answer.status === 404 && content?.error === NOTHING) throw new ServerError(MOVED);
  const words = content?.error ?? `The server answered ${answer.status} to ${method} ${place}.`;
  throw new ServerError(words, { status: answer.status, revision: content?.revision ?? null });
}

/** What only the last message of a job holds. */
const OUTCOMES = ["error", "field", "object", "revision"];

const json = (content) => ({ body: JSON.stringify(content), headers: { "Content-Type": "application/json" } });
const wav = (body, headers = {}) => ({ body, headers: { "Content-Type": "audio/wav", ...headers } });

const expecting = (digest) => (digest ? { "If-Match": digest } : {});

/** A strike's address; its file may lie in a folder of its own. */
export const strikePlace = (file) => `capture/strikes/${file.split("/").map(encodeURIComponent).join("/")}`;

/** Numbers that came as base64 of float32, little endian. */
export function numbers(text) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  return new Float32Array(bytes.buffer);
}

export const server = {
  manifest: () => ask("GET", "manifest.json"),

  /** Where a recording was struck. */
  locate: (recording) => ask("POST", "locate", wav(recording)),

  edit: (base, change) => ask("POST", "edit", json({ base, ...change })),
  lead: (base, recording) => ask("POST", `lead?base=${base}`, wav(recording)),
  undo: (base) => ask("POST", "undo", json({ base })),
  save: (base, name) => ask("POST", "save", json({ base, name })),

  capture: () => ask("GET", "capture"),
  checkStrike: (recording) => ask("POST", "capture/check", wav(recording)),

  /** Add a strike; the same recording and contact twice add it once. */
  addStrike: (recording, { contact, direction }) => {
    const query = new URLSearchParams();
    ["x", "y", "z"].forEach((axis, place) => query.set(axis, contact[place]));
    if (direction) ["nx", "ny", "nz"].forEach((axis, place) => query.set(axis, direction[place]));
    return ask("POST", `capture/strikes?${query}`, wav(recording));
  },
  // With the strike's digest, as `capture` tells it, it is changed only if no other tab was faster.
  redoStrike: (file, recording, { digest }) => ask("PUT", strikePlace(file), wav(recording, expecting(digest))),
  removeStrike: (file, { digest } = {}) => ask("DELETE", strikePlace(file), { headers: expecting(digest) }),

  reconstruct: () => ask("POST", "reconstruct"),
  makeObject: () => ask("POST", "object"),
  cancel: (job) => ask("DELETE", `jobs/${encodeURIComponent(job)}`),

  /** Hear of a job's progress; `heard` gets every message, the last of which holds what came of it or "error". */
  follow(job, heard) {
    const source = new EventSource(`jobs/${encodeURIComponent(job)}/events`);
    const take = (event) => {
      const message = JSON.parse(event.data);
      const ended = message.stage === "cancelled" || OUTCOMES.some((name) => name in message);
      if (ended) source.close();
      heard(message, ended);
    };
    source.onmessage = take;
    // The source tries again by itself while it is connecting; only a source that has given up is closed.
    source.onerror = () => {
      if (source.readyState === EventSource.CLOSED) heard({ error: GONE }, true);
      else heard({ words: "Connection lost; reconnecting …" }, false);
    };
  },
};
