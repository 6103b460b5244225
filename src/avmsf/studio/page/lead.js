/** Lead the sound towards a recording or words: minutes of work, during which the sliders rest. */

import { button, element, filePicker, group, line, say } from "./dom.js";
import { JobProgress } from "./jobprogress.js";
import { server } from "./server.js";

/** What the server calls this kind of job. */
export const LEADING = "guided edit";

/** `hold(work, "minutes")` keeps the field from being changed by hand while work goes on. */
export function leadGroup(studio, changes, hold) {
  const progress = new JobProgress();

  /** `ask()` sends the request that begins it. */
  const lead = (ask) =>
    hold(async () => {
      progress.begin("Starting …");
      const again = () => lead(ask);
      const begun = await changes.queue(async () => (await changes.settle()) && changes.ask(ask, { again }));
      if (begun) await follow(begun.job);
      else progress.end();
    }, "minutes");
  const follow = async (job) => {
    const steps = [];
    const last = await progress.follow(job, (message) => {
      // Other stages have no loss, and a step that came to none says so.
      if (Number.isFinite(message.loss)) steps.push(message);
    });
    if (last.error) say(last.error, { name: "edit", bad: true });
    else if (last.revision !== undefined) {
      const shown = await changes.queue(() => changes.show(last, { sliders: true }));
      if (shown) {
        studio.strikeAgain();
        say(summaryOf(steps), { name: "led" });
      }
    }
  };

  const leadLike = async (file) => lead(() => server.lead(studio.revision, file));
  const rows = [filePicker("Towards a recording …", ".wav,audio/wav", leadLike)];
  if (studio.can("words")) {
    const placeholder = "a wooden bowl is hit";
    const text = element("input", { type: "text", "aria-label": "Description of the sound", placeholder });
    rows.push(text, button("Towards this text", () => lead(() => server.edit(studio.revision, { prompt: text.value }))));
  }
  // One that was under way before the page was loaded goes on.
  const { job, jobKind } = studio.live;
  if (job && jobKind === LEADING) hold(() => follow(job), "minutes");

  return group(element("h2", {}, "Guided edit"), line(...rows, progress.stop), progress.bar, progress.stage);
}

/** What a descent of these steps, {loss, pitch} each, has come to. */
function summaryOf(steps) {
  if (!steps.length) return "Guided edit finished.";
  const [first, last] = [steps[0], steps.at(-1)];
  const losses = `${first.loss.toPrecision(2)} to ${last.loss.toPrecision(2)}`;
  return `Guided edit finished: pitch × ${last.pitch.toPrecision(3)}, loss from ${losses}. Undo reverts it.`;
}
