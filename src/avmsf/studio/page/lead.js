/** Lead the sound towards a recording or words: minutes of work, during which the sliders rest. */

import { button, element, filePicker, say } from "./dom.js";
import { JobProgress } from "./jobprogress.js";
import { server } from "./server.js";

/** What the server calls this kind of job. */
const KIND = "lead the sound";

/** `hold(work, "minutes")` keeps the field from being changed by hand while work goes on. */
export function leadGroup(studio, changes, hold) {
  const progress = new JobProgress();

  const lead = (towards) =>
    hold(async () => {
      const start = () => server.edit(studio.revision, towards);
      const again = () => lead(towards);
      const begun = await changes.queue(async () => (await changes.settle()) && changes.ask(start, { again }));
      if (begun) await follow(begun.job);
    }, "minutes");
  const follow = async (job) => {
    const last = await progress.follow(job);
    if (last.error) say(last.error, { name: "edit", bad: true });
    else if (last.revision !== undefined) {
      const shown = await changes.queue(() => changes.show(last, { sliders: true }));
      if (shown) studio.strikeAgain();
    }
  };

  const rows = [filePicker("Towards a recording …", ".wav,audio/wav", async (file) => lead({ like: await base64(file) }))];
  if (studio.can("words")) {
    const placeholder = "a wooden bowl is hit";
    const text = element("input", { type: "text", "aria-label": "What it should sound like", placeholder });
    rows.push(text, button("Towards these words", () => lead({ prompt: text.value })));
  }
  // One that was under way before the page was loaded goes on. Without a capture there are no jobs of other kinds.
  const { job, jobKind = studio.can("reconstruct") ? null : KIND } = studio.live;
  if (job && jobKind === KIND) hold(() => follow(job), "minutes");

  return element(
    "div",
    { className: "group" },
    element("h2", {}, "Lead the sound"),
    element("div", { className: "row" }, ...rows, progress.stop),
    progress.bar,
    progress.stage,
  );
}

async function base64(file) {
  const bytes = new Uint8Array(await file.arrayBuffer());
  let letters = "";
  for (const byte of bytes) letters += String.fromCharCode(byte);
  return btoa(letters);
}
