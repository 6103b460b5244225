/** Recordings on their way to the server: kept in the browser until the server has said that it holds them. */

const NAME = "avmsf-outbox";
const STORE = "recordings";

function answered(request) {
  return new Promise((resolve, reject) => {
    request.onsuccess = () => resolve(request.result);
    request.onerror = () => reject(request.error);
  });
}

function openDatabase() {
  const request = indexedDB.open(NAME, 1);
  request.onupgradeneeded = () => request.result.createObjectStore(STORE, { keyPath: "key" });
  return answered(request);
}

/** A box of entries {key, made, …}, `made` in ms; outlives the page where the browser can, and lives as long as the page where not. */
export class Outbox {
  #entries = new Map();
  #database = null;
  #owner = null;
  #lasting = false;

  static async open() {
    const box = new Outbox();
    box.#database = await openDatabase().catch(() => null);
    return box;
  }

  /**
   * Say whose recordings these are, by a name that outlives the server; what an earlier page left under it comes back.
   * Until then entries live in the page alone. Gives what came back, oldest first.
   */
  async belongTo(owner) {
    if (this.#owner === owner) return [];
    this.#owner = owner;
    if (!this.#database) return [];
    const here = this.entries;
    let left;
    try {
      left = await answered(this.#database.transaction(STORE).objectStore(STORE).getAll());
    } catch {
      return [];
    }
    const mine = left.filter((entry) => entry.owner === owner).sort((one, other) => one.made - other.made);
    this.#entries = new Map([...mine, ...here].map((entry) => [entry.key, entry]));
    this.#lasting = true;
    for (const entry of here) await this.put(entry);
    return mine;
  }

  /** Do something to the store, and wait until it is written, which a request's success does not promise. */
  async #change(action) {
    const transaction = this.#database.transaction(STORE, "readwrite", { durability: "strict" });
    const written = new Promise((resolve, reject) => {
      transaction.oncomplete = resolve;
      transaction.onabort = () => reject(transaction.error);
    });
    action(transaction.objectStore(STORE));
    await written;
  }

  /** Whether the entries outlive a reload. */
  get lasting() {
    return this.#lasting;
  }

  /** Where the entries are safe, in a sentence. */
  get refuge() {
    return this.#lasting
      ? "Unsent recordings are stored in this browser, even if you close the page; a studio restarted at the same " +
          "port shows them again."
      : "Unsent recordings are stored only in this open page: do not close it.";
  }

  get entries() {
    return [...this.#entries.values()];
  }

  has(key) {
    return this.#entries.has(key);
  }

  async put(entry) {
    this.#entries.set(entry.key, entry);
    if (!this.#lasting) return;
    try {
      await this.#change((store) => store.put({ ...entry, owner: this.#owner }));
    } catch {
      // Full or forbidden: it still lives in the page.
      this.#lasting = false;
    }
  }

  async remove(key) {
    this.#entries.delete(key);
    // Also from a store that takes nothing new: what was sent must not come back. Where even this fails, the server
    // finds the recording in its folder.
    if (this.#database) await this.#change((store) => store.delete(key)).catch(() => {});
  }
}

/** A name that no other recording has; without a secure context there is no randomUUID. */
export function newKey() {
  const bytes = crypto.getRandomValues(new Uint8Array(16));
  return [...bytes].map((byte) => byte.toString(16).padStart(2, "0")).join("");
}
