/** The list of recordings that the server does not have yet: sent, sent again, and reported where it cannot be. */

import { server } from "./api.js";
import { describeContact } from "./contactchoice.js";
import { faint, group, line, say, smallButton, unsay, warning } from "./dom.js";
import { listenButton } from "./recordingcard.js";

const RETRY_MS = 3000;

export class UnsentRecordings {
  #sending = false;
  #timer = null;

  /** `impacts()` are those that the server has, `shown()` the recording that is shown elsewhere, `sent()` is called. */
  constructor(outbox, { impacts, shown, sent }) {
    Object.assign(this, { outbox, impacts, shown, sent });
    this.element = group();
    window.addEventListener("online", () => this.send());
  }

  /** Send all that is to be saved. */
  async send() {
    if (this.#sending) return;
    this.#sending = true;
    clearTimeout(this.#timer);
    let [entry, answered] = [null, true];
    while (answered && (entry = this.outbox.entries.find(({ kept, refused }) => kept && !refused))) {
      this.show();
      answered = await this.#sendOne(entry);
    }
    this.#sending = false;
    this.show();
    if (answered) await this.sent();
  }

  /** Send a recording; gives whether the server answered at all. */
  async #sendOne(entry) {
    try {
      if (entry.redo) await server.replaceRecording(entry.redo, entry.blob, entry);
      else await server.addImpact(entry.blob, entry);
    } catch (error) {
      if (!error.refusal) {
        const words = `The recording is not lost, and is sent again until the server answers. ${error.message}`;
        say(`${words} ${this.outbox.refuge}`, { name: "outbox" });
        this.#timer = setTimeout(() => this.send(), RETRY_MS);
        return false;
      }
      // It may have been discarded while it was on its way.
      if (this.outbox.has(entry.key)) await this.outbox.put({ ...entry, refused: error.message, status: error.status });
      return true;
    }
    await this.outbox.remove(entry.key);
    unsay("outbox");
    return true;
  }

  async keep(entry) {
    await this.outbox.put({ ...entry, kept: true, refused: undefined, status: undefined });
    await this.send();
  }

  show() {
    const entries = this.outbox.entries.filter(({ key }) => key !== this.shown()?.key);
    this.element.replaceChildren(...entries.map((entry) => this.#item(entry)));
  }

  #item(entry) {
    const { kept, refused } = entry;
    const state = !kept ? "is not saved yet." : refused ? `was rejected: ${refused}` : "waits for the server …";
    const words = `The recording ${describeContact(entry)} ${state}`;
    const discard = () => this.outbox.remove(entry.key).then(() => this.show());
    return group(
      kept && !refused ? faint(words) : warning(words),
      line(...this.#answers(entry), listenButton(entry.blob), smallButton("Discard", discard)),
    );
  }

  /** What can be done with a recording; one that came too late for its impact never takes its place unasked. */
  #answers(entry) {
    const answer = (words, changed = {}) => smallButton(words, () => this.keep({ ...entry, ...changed }));
    if (!entry.kept) return [answer("Save recording")];
    if (!entry.redo || !entry.refused) return [answer("Send again")];
    const impact = this.impacts().find(({ file }) => file === entry.redo);
    const answers = [];
    if (entry.status === 409 && impact) answers.push(answer("Replace it with mine", { digest: impact.digest }));
    else if (impact) answers.push(answer("Send again"));
    if (entry.contact) answers.push(answer("Add it as a new impact", { redo: null, digest: null }));
    return answers;
  }
}
