/** Changes of the open field: one at a time, each of the revision that this page knows, and no other tab's is lost. */

import { say, unsay } from "./dom.js";
import { server } from "./server.js";

const SETTLED_MS = 200;

export class Changes {
  #last = Promise.resolve();
  #timer = null;
  #unsent = false;
  #lost = false;

  /**
   * `load()` fetches the server's present bundle and takes it; `wish()` gives what the sliders ask for; `takeSliders()`
   * puts them where the server has them; `onBusy(busy)` hears when the server works.
   */
  constructor(studio, { load, wish, takeSliders, onBusy }) {
    Object.assign(this, { studio, load, wish, takeSliders, onBusy });
  }

  /** A slider has moved; what the sliders say together is sent when they rest. */
  moved() {
    this.#unsent = true;
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => this.queue(() => this.settle()), SETTLED_MS);
  }

  /** Do something when all that was asked for earlier is done; gives what it gave. */
  queue(action) {
    this.#last = this.#last.then(action).catch((error) => say(error.message, { name: "edit", bad: true }));
    return this.#last;
  }

  /** Within the queue: send what the sliders say unless the server has it; gives whether it has it now. */
  async settle() {
    clearTimeout(this.#timer);
    if (!this.#unsent) return true;
    this.#unsent = false;
    const answer = await this.ask(() => server.edit(this.studio.revision, this.wish()), {
      again: () => this.queue(() => this.settle()),
      refused: [["Revert it", () => this.#take()]],
    });
    if (!answer) {
      this.#unsent = true;
      return false;
    }
    if (await this.show(answer)) this.studio.strikeAgain();
    return true;
  }

  /**
   * Within the queue: do what changes the field; undefined where it failed, which is said. Where another tab was faster
   * nothing is overwritten, and the user chooses; `mine` is false for what makes no sense on top of its change, which
   * is shown then.
   */
  async ask(action, { again, mine = true, refused = [] }) {
    this.onBusy(true);
    try {
      const answer = await action();
      this.#lost = false;
      unsay("edit");
      return answer;
    } catch (error) {
      if (error.stale && mine) this.#tellStale(error, again);
      else if (error.stale) await this.#showStale(error);
      else {
        const answers = error.unreachable ? [["Try again", again]] : refused;
        say(error.message, { name: "edit", bad: true, answers });
      }
      this.#lost = Boolean(error.unreachable);
      return undefined;
    } finally {
      this.onBusy(false);
    }
  }

  /**
   * Within the queue: take the bundle that an answer speaks of, and with `sliders` the server's sliders; gives whether
   * it is the one that is heard now.
   */
  async show({ revision }, { sliders = false } = {}) {
    const { studio } = this;
    try {
      await this.load();
    } catch (error) {
      studio.revision = revision;
      const again = () => this.queue(() => this.show({ revision }, { sliders }));
      say(error.message, { name: "reload", bad: true, answers: [["Try again", again]] });
      return false;
    }
    unsay("reload");
    const theirs = studio.revision !== revision;
    if (sliders || (theirs && !this.#unsent)) this.#take();
    // Sliders that have moved on are of the answered revision: the server will say that it is not the last.
    else studio.revision = revision;
    if (theirs) say("Another tab changed this field after your change: the page shows its current state.", { name: "edit" });
    return !theirs;
  }

  get #meanwhile() {
    return this.#lost
      ? "Another tab changed this field, or your last change was made although its answer was lost."
      : "Another tab has changed this field.";
  }

  async #showStale({ revision }) {
    const meanwhile = this.#meanwhile;
    if (await this.show({ revision }, { sliders: true }))
      say(`${meanwhile} The page shows its current state: repeat your change if you still want it.`, { name: "edit" });
  }

  #tellStale({ revision }, again) {
    const answers = [["Show that change", () => this.queue(() => this.show({ revision }, { sliders: true }))]];
    const insist = () => {
      this.studio.revision = revision;
      // Whatever is to be done next is done with this page's sliders, not with those of the other tab.
      this.#unsent = true;
      again();
    };
    answers.push(["Replace it with mine", insist]);
    const choice = "Nothing was overwritten: show that change, or replace it with yours.";
    say(`${this.#meanwhile} ${choice}`, { name: "edit", bad: true, answers });
  }

  #take() {
    clearTimeout(this.#timer);
    this.#unsent = false;
    this.takeSliders();
  }
}
