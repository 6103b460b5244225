/** From the strikes to a field, or from pictures to an object: minutes of work with its progress, and a way to stop. */

import { attempt, button, element, line, say } from "./dom.js";
import { JobProgress } from "./jobprogress.js";
import { LEADING } from "./lead.js";
import { server } from "./server.js";

const FEWEST = 2;

export function reconstructGroup(studio) {
  const words = element("p", { className: "faint" });
  const progress = new JobProgress();
  let ready = false;

  const allow = () => {
    go.disabled = !ready || progress.job !== null;
  };
  const go = button(
    "Reconstruct the field",
    async () => {
      go.disabled = true;
      const begun = await attempt(() => server.reconstruct(), "job");
      if (begun) await follow(begun.job);
      allow();
    },
    { className: "main" },
  );
  const follow = async (job) => {
    const followed = progress.follow(job);
    allow();
    const last = await followed;
    allow();
    if (last.error) say(last.error, { name: "job", bad: true });
    else if (last.field) await tell(last.field);
    else if (last.object) location.reload();
  };
  const tell = async (field) => {
    progress.stage.textContent = `Field saved: ${field}`;
    const manifest = await server.manifest().catch(() => null);
    if (manifest?.live?.mode === "field") {
      const answers = [["Open it", () => location.reload()]];
      say("The sound field is ready.", { name: "job", answers });
    } else say(`The sound field is ready. Open it with: avmsf studio ${field}`, { name: "job" });
  };

  // A job that was under way before the page was loaded goes on; an edit is shown by the tab that began it.
  const { job, jobKind } = studio.live;
  if (job && jobKind !== LEADING) follow(job);

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
    /** Tell how many strikes there are, and whether the capture can be read. */
    setReady(count, readable = true) {
      const lacking = Math.max(0, FEWEST - count);
      words.textContent = lacking
        ? `Add at least ${lacking} more ${lacking === 1 ? "impact" : "impacts"}; use about a dozen, spread over the object.`
        : readable
          ? "Fits a sound field to these recordings. Takes minutes; you can add impacts later."
          : "First correct the problems listed above.";
      ready = lacking === 0 && readable;
      allow();
    },
  };
}
