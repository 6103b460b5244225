/** The progress of work of minutes on the server, and a way to stop it. */

import { button, element, say } from "./dom.js";
import { server } from "./server.js";

export class JobProgress {
  constructor() {
    this.job = null;
    this.bar = element("progress", { hidden: true, "aria-label": "Progress" });
    this.stage = element("small", { "aria-live": "polite" });
    const complain = (error) => say(error.message, { name: "job", bad: true });
    this.stop = button("Stop", () => server.cancel(this.job).catch(complain), { hidden: true });
  }

  /** Say at once that a job begins, of which the server has not said anything yet. */
  begin(words) {
    this.bar.hidden = false;
    this.bar.removeAttribute("value");
    this.stage.textContent = words;
  }

  /** Show no job any more. */
  end(words = "") {
    [this.job, this.bar.hidden, this.stop.hidden] = [null, true, true];
    this.stage.textContent = words;
  }

  /** Show how a job goes; gives its last message, which holds what came of it, or "error". `heard` gets all of them. */
  follow(job, heard = () => {}) {
    this.job = job;
    this.begin("Started; the first progress report takes some seconds …");
    this.stop.hidden = false;
    return new Promise((end) => {
      server.follow(job, (message, ended) => {
        if (message.total) [this.bar.max, this.bar.value] = [message.total, message.done ?? 0];
        else if (message.stage) this.bar.removeAttribute("value");
        const words = [message.stage, message.words].filter(Boolean).join(": ");
        this.stage.textContent = words;
        heard(message);
        if (!ended) return;
        this.end(words);
        end(message);
      });
    });
  }
}
