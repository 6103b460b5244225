/** Work of minutes on the server: its progress and a way to stop it; from impacts to a field. */

import { server } from "./api.js";
import { attempt, button, element, faint, line, say } from "./dom.js";

const MIN_IMPACTS = 2;

export class JobProgress {
  constructor() {
    this.job = null;
    this.bar = element("progress", { hidden: true, "aria-label": "Progress" });
    this.stage = element("small", { "aria-live": "polite" });
    this.stop = button("Stop", () => attempt(() => server.cancel(this.job), "job"), { hidden: true });
  }

  /** Say at once that a job begins, of which the server has not said anything yet. */
  begin(words) {
    this.bar.hidden = false;
    this.bar.removeAttribute("value");
    this.stage.textContent = words;
  }

  end(words = "") {
    [this.job, this.bar.hidden, this.stop.hidden] = [null, true, true];
    this.stage.textContent = words;
  }

  /** Show how a job goes; gives its last message, with its result or "error". `take` is called with all of them. */
  follow(job, take = () => {}) {
    this.job = job;
    this.begin("Started; the first progress report takes some seconds …");
    this.stop.hidden = false;
    return new Promise((resolve) => {
      server.follow(job, (message, ended) => {
        if (message.total) [this.bar.max, this.bar.value] = [message.total, message.done ?? 0];
        else if (message.stage) this.bar.removeAttribute("value");
        const words = [message.stage, message.words].filter(Boolean).join(": ");
        this.stage.textContent = words;
        take(message);
        if (!ended) return;
        this.end(words);
        resolve(message);
      });
    });
  }
}

/** The section that reconstructs a field from a capture's impacts. */
export function reconstructGroup(studio) {
  const words = faint("");
  const progress = new JobProgress();
  let ready = false;
  const enable = () => {
    go.disabled = !ready || progress.job !== null;
  };
  const start = async () => {
    go.disabled = true;
    const started = await attempt(() => server.reconstruct(), "job");
    if (started) await follow(started.job);
    enable();
  };
  const go = button("Reconstruct the field", start, { className: "main" });
  const follow = async (job) => {
    const followed = progress.follow(job);
    enable();
    const last = await followed;
    enable();
    if (last.error) say(last.error, { name: "job", bad: true });
    else if (last.object) location.reload();
    else if (last.field) {
      progress.stage.textContent = `Field saved: ${last.field}`;
      say("The sound field is ready.", { name: "job", answers: [["Open it", () => location.reload()]] });
    }
  };

  // A job that was running before the page was loaded goes on; an edit is shown by the tab that started it.
  const { job, jobKind } = studio.live;
  if (job && jobKind !== "lead") follow(job);

  return {
    element: element(
      "div",
      { className: "group", hidden: !studio.can("reconstruct") },
      element("h2", {}, "3. Reconstruct"),
      words,
      line(go, progress.stop),
      progress.bar,
      progress.stage,
    ),
    /** Tell how many impacts there are, and whether the capture can be read. */
    setReady(count, readable) {
      const missing = Math.max(0, MIN_IMPACTS - count);
      const impacts = missing === 1 ? "impact" : "impacts";
      words.textContent = missing
        ? `Add at least ${missing} more ${impacts}; use about a dozen, spread over the object.`
        : readable
          ? "Fits a sound field to these recordings. Takes minutes; you can add impacts later."
          : "First correct the problems listed above.";
      ready = missing === 0 && readable;
      enable();
    },
  };
}
