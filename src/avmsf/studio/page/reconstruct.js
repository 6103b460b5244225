/** From the strikes to a field, or from pictures to an object: minutes of work with its progress, and a way to stop. */

import { button, element, say } from "./dom.js";
import { server } from "./server.js";

const FEWEST = 2;

export function reconstructGroup(studio) {
  const words = element("p", { className: "faint" });
  const progress = element("progress", { hidden: true, "aria-label": "Progress" });
  const stage = element("small", { "aria-live": "polite" });
  let job = null;
  let strikes = 0;

  const rest = () => {
    [job, progress.hidden, go.textContent] = [null, true, "Make the sound field"];
    go.disabled = strikes < FEWEST;
  };
  const go = button(
    "Make the sound field",
    async () => {
      if (job) {
        go.disabled = true;
        await server.cancel(job).catch((error) => say(error.message, { name: "job", bad: true }));
        return;
      }
      try {
        follow((await server.reconstruct()).job);
      } catch (error) {
        say(error.message, { name: "job", bad: true });
      }
    },
    { className: "main" },
  );
  const follow = (started) => {
    job = started;
    [go.textContent, go.disabled, progress.hidden] = ["Stop", false, false];
    progress.removeAttribute("value");
    server.follow(job, heard);
  };
  const heard = (message, ended) => {
    if (message.total) [progress.max, progress.value] = [message.total, message.done ?? 0];
    else if (message.stage) progress.removeAttribute("value");
    stage.textContent = [message.stage, message.words].filter(Boolean).join(": ");
    if (!ended) return;
    rest();
    if (message.error) say(message.error, { name: "job", bad: true });
    else if (message.field) opened(message.field);
    else if (message.object) location.reload();
  };
  const opened = async (field) => {
    stage.textContent = `The field is written: ${field}`;
    const manifest = await server.manifest().catch(() => null);
    if (manifest?.live?.mode === "field") {
      const answers = [["Strike it", () => location.reload()]];
      say("The sound field is ready.", { name: "job", answers });
    } else say(`The sound field is ready. Open it by: avmsf studio ${field}`, { name: "job" });
  };

  // A job that was under way before the page was loaded goes on.
  if (studio.live.job) follow(studio.live.job);

  return {
    element: element(
      "div",
      { className: "group", hidden: !studio.can("reconstruct") },
      element("h2", {}, "3. Reconstruct"),
      words,
      element("div", { className: "row" }, go),
      progress,
      stage,
    ),
    /** Tell how many strikes there are, and whether the capture can be read. */
    setReady(count, readable = true) {
      strikes = count;
      const lacking = Math.max(0, FEWEST - count);
      words.textContent = lacking
        ? `Add ${lacking} more ${lacking === 1 ? "strike" : "strikes"}; a dozen, spread over the object, sound well.`
        : readable
          ? "Learns from these strikes how the object sounds everywhere. Takes minutes; more strikes can follow."
          : "Mend what is said above first.";
      if (!job) go.disabled = lacking > 0 || !readable;
    },
  };
}
