/** Recordings on their way to the server: stored in the browser until the server has said that it holds them. */

const NAME = "avmsf-outbox";
const STORE = "recordings";

function answered(request) {
  return new Promise((resolve, reject) => {
    request.onsuccess = () => resolve(request.result);
    request.onerror = () => reject(request.error);
  });
}

/** Entries {key, made, …}, `made` in ms; they outlive the page where the browser allows it, and not where not. */
export class Outbox {
  #entries = new Map();
  #database = null;

  /** The box of an owner, named so that it outlives the server, with what an earlier page left in it, oldest first. */
  static async open(owner) {
    const box = new Outbox();
    box.owner = owner;
    box.lasting = false;
    try {
      const request = indexedDB.open(NAME, 1);
      request.onupgradeneeded = () => request.result.createObjectStore(STORE, { keyPath: "key" });
      box.#database = await answered(request);
      const all = await answered(box.#database.transaction(STORE).objectStore(STORE).getAll());
      const left = all.filter((entry) => entry.owner === owner).sort((one, other) => one.made - other.made);
      for (const entry of left) box.#entries.set(entry.key, entry);
      box.lasting = true;
    } catch {
      // Without a database, as in some private windows, entries live in the page alone.
    }
    return box;
  }

  /** Change the store, and wait until it is written, which a request's success does not promise. */
  async #change(action) {
    const transaction = this.#database.transaction(STORE, "readwrite", { durability: "strict" });
    const written = new Promise((resolve, reject) => {
      transaction.oncomplete = resolve;
      transaction.onabort = () => reject(transaction.error);
    });
    action(transaction.objectStore(STORE));
    await written;
  }

  /** Where the entries are safe, in a sentence. */
  get refuge() {
    return this.lasting
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
    if (!this.lasting) return;
    try {
      await this.#change((store) => store.put({ ...entry, owner: this.owner }));
    } catch {
      // Full or forbidden: it still lives in the page.
      this.lasting = false;
    }
  }

  async remove(key) {
    this.#entries.delete(key);
    // Also from a store that takes nothing new: what was sent must not come back. Where even this fails, the server
    // finds the recording in its folder.
    if (this.#database) await this.#change((store) => store.delete(key)).catch(() => {});
  }
}
