/** Changes of the open field: one at a time, each of the revision that this page shows; the server refuses others. */

import { server } from "./api.js";
import { say, unsay } from "./dom.js";

const SETTLED_MS = 200;
const CHANGED_ELSEWHERE =
  "Another tab has changed this field, or your last change was made although its answer was lost: the page shows the " +
  "current state. Repeat your change if you still want it.";

export class Changes {
  #last = Promise.resolve();
  #timer = null;
  /** Movements of the sliders, and how many of them the server has. */
  #moves = 0;
  #sent = 0;

  /**
   * `load()` fetches the server's current bundle and takes it; `request()` is what the sliders ask for; `takeSliders()`
   * puts them where the server has them; `busy` is an element that is shown while the server works.
   */
  constructor(studio, { load, request, takeSliders, busy }) {
    Object.assign(this, { studio, load, request, takeSliders, busy });
  }

  /** A slider has moved; what the sliders ask for together is sent when they rest. */
  moved() {
    this.#moves++;
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => this.queue(() => this.settle()), SETTLED_MS);
  }

  /** Do something when all that was asked for earlier is done; gives its result. */
  queue(action) {
    this.#last = this.#last.then(action).catch((error) => say(error.message, { name: "edit", bad: true }));
    return this.#last;
  }

  /** Within the queue: send what the sliders ask for unless the server has it; gives whether it has it now. */
  async settle() {
    clearTimeout(this.#timer);
    const moves = this.#moves;
    if (moves === this.#sent) return true;
    const answer = await this.ask(() => server.edit(this.studio.revision, this.request()), {
      again: () => this.queue(() => this.settle()),
      refused: [["Revert it", () => this.#take()]],
    });
    if (!answer) return false;
    this.#sent = moves;
    if (await this.show(answer)) this.studio.strikeAgain();
    return true;
  }

  /** Within the queue: do what changes the field; undefined if it failed, which is said, or another tab was faster. */
  async ask(action, { again, refused = [] }) {
    this.busy.hidden = false;
    try {
      const answer = await action();
      unsay("edit");
      return answer;
    } catch (error) {
      const answers = error.unreachable ? [["Try again", again]] : refused;
      if (!error.stale) say(error.message, { name: "edit", bad: true, answers });
      else if (await this.show(error, { sliders: true })) say(CHANGED_ELSEWHERE, { name: "edit" });
      return undefined;
    } finally {
      this.busy.hidden = true;
    }
  }

  /**
   * Within the queue: take the bundle of a revision, and with `sliders` the server's sliders; gives whether this is
   * what is played now, and not the change of another tab.
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
    const current = studio.revision === revision;
    if (sliders || !current) this.#take();
    if (!current) say(CHANGED_ELSEWHERE, { name: "edit" });
    return current;
  }

  #take() {
    clearTimeout(this.#timer);
    this.#sent = this.#moves;
    this.takeSliders();
  }
}
