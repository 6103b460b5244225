/** Recordings on their way to the server: kept in the browser until the server has said that it holds them. */

const NAME = "avmsf-outbox";
const STORE = "recordings";

function openStore() {
  return new Promise((resolve, reject) => {
    const request = indexedDB.open(NAME, 1);
    request.onupgradeneeded = () => request.result.createObjectStore(STORE, { keyPath: "key" });
    request.onsuccess = () => resolve(request.result);
    request.onerror = () => reject(request.error);
  });
}

function done(request) {
  return new Promise((resolve, reject) => {
    request.onsuccess = () => resolve(request.result);
    request.onerror = () => reject(request.error);
  });
}

/** A box of entries {key, …}; outlives the page where the browser can, and lives as long as the page where not. */
export class Outbox {
  #entries = new Map();
  #database = null;

  /** Open the box of one opened folder, `owner`, with what an earlier page left in it. */
  static async open(owner) {
    const box = new Outbox();
    box.owner = owner;
    try {
      box.#database = await openStore();
      const left = await done(box.#store("readonly").getAll());
      for (const entry of left) if (entry.owner === owner) box.#entries.set(entry.key, entry);
    } catch {
      box.#database = null;
    }
    return box;
  }

  #store(mode) {
    return this.#database.transaction(STORE, mode).objectStore(STORE);
  }

  /** Whether the entries outlive a reload. */
  get lasting() {
    return this.#database !== null;
  }

  get entries() {
    return [...this.#entries.values()];
  }

  async put(entry) {
    this.#entries.set(entry.key, entry);
    if (!this.#database) return;
    try {
      await done(this.#store("readwrite").put({ ...entry, owner: this.owner }));
    } catch {
      // Full or forbidden: it still lives in the page.
      this.#database = null;
    }
  }

  async remove(key) {
    this.#entries.delete(key);
    if (this.#database) await done(this.#store("readwrite").delete(key)).catch(() => {});
  }
}

/** A name that no other recording has; without a secure context there is no randomUUID. */
export function newKey() {
  const bytes = crypto.getRandomValues(new Uint8Array(16));
  return [...bytes].map((byte) => byte.toString(16).padStart(2, "0")).join("");
}
