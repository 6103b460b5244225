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

  /** Show how a job goes; gives its last message, which holds what came of it, or "error". */
  follow(job) {
    this.job = job;
    [this.bar.hidden, this.stop.hidden] = [false, false];
    this.bar.removeAttribute("value");
    return new Promise((end) => {
      server.follow(job, (message, ended) => {
        if (message.total) [this.bar.max, this.bar.value] = [message.total, message.done ?? 0];
        else if (message.stage) this.bar.removeAttribute("value");
        this.stage.textContent = [message.stage, message.words].filter(Boolean).join(": ");
        if (!ended) return;
        [this.job, this.bar.hidden, this.stop.hidden] = [null, true, true];
        end(message);
      });
    });
  }
}
