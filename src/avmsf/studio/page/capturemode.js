/** The tab that makes a capture: click where one is about to strike, record, look at it at once, keep it or redo it. */

import { attempt, button, element, filePicker, say, unsay } from "./dom.js";
import { newKey, Outbox } from "./outbox.js";
import { MicrophoneError, Recorder } from "./recorder.js";
import { reconstructGroup } from "./reconstruct.js";
import { server } from "./server.js";
import { drawTake, listenButton, measures } from "./takes.js";
import { looksLikeWav } from "./wav.js";

const RETRY_MS = 3000;

export async function captureSheet(studio) {
  let capture = (await attempt(() => server.capture(), "capture")) ?? { folder: "", strikes: [] };
  const outbox = await Outbox.open(capture.folder || location.pathname);
  const next = { contact: null, direction: null, redo: null };
  let take = null;

  const place = element("div", { className: "place" });
  const inputs = ["x", "y", "z"].map((axis) => {
    const input = element("input", { type: "number", step: "any", oninput: () => typedPlace() });
    place.append(element("label", {}, `${axis}, mm`, input));
    return input;
  });
  const where = element("p", { className: "faint" }, "Click the object where you are about to strike.");
  const level = element("meter", { min: 0, max: 1, high: 0.95, "aria-label": "Microphone level" });
  const heard = element("small");
  const judged = element("div", { className: "group", hidden: true });
  const waiting = element("div", { className: "group" });
  const list = element("ul", { className: "listing" });
  const count = element("h2");
  const problems = element("div", { className: "group" });
  const reconstruction = reconstructGroup(studio);

  // Where

  const setPlace = (contact, direction) => {
    Object.assign(next, { contact, direction });
    inputs.forEach((input, axis) => {
      input.value = contact ? (1000 * contact[axis]).toFixed(2) : "";
    });
    markNext();
    showTarget();
  };
  const typedPlace = () => {
    if (inputs.some((input) => input.value === "" || !Number.isFinite(input.valueAsNumber))) return;
    next.contact = inputs.map((input) => input.valueAsNumber / 1000);
    next.direction = studio.view ? inward(studio.view.contactAt(next.contact).normal) : null;
    markNext();
    showTarget();
  };
  const markNext = () => {
    if (!studio.view) return;
    if (!next.contact) {
      studio.view.unmark("next");
      return;
    }
    const dot = element("div", { className: "dot next" });
    const mark = element("div", { className: "mark" }, dot, element("span", { className: "label" }, "strike here"));
    studio.view.mark("next", mark, next.contact, next.direction?.map((value) => -value) ?? null);
  };
  const showTarget = () => {
    where.textContent = next.redo
      ? `Strike again where ${next.redo} was struck.`
      : next.contact
        ? "Now record the blow, or attach its recording."
        : "Click the object where you are about to strike.";
    for (const control of [record, attach.querySelector("input")])
      control.disabled = !next.contact && !next.redo && !recorder.recording;
    stopRedo.hidden = next.redo === null;
  };
  const stopRedo = button("Leave it as it is", () => {
    next.redo = null;
    setPlace(null, null);
  });

  // Record, or attach

  const recorder = new Recorder(({ peak, seconds, struck }) => {
    level.value = peak;
    heard.textContent = `${seconds.toFixed(1)} s, ${struck ? "blow heard" : "waiting for the blow"}`;
  });
  const record = button(
    "● Record",
    async () => {
      if (recorder.recording) {
        recorder.stop();
        return;
      }
      record.textContent = "■ Stop";
      record.classList.add("recording");
      try {
        const { blob } = await recorder.record();
        await judge(blob);
      } catch (error) {
        if (!(error instanceof MicrophoneError)) throw error;
        say(error.message, { name: "microphone", bad: true });
      } finally {
        record.textContent = "● Record";
        record.classList.remove("recording");
      }
    },
    { className: "main" },
  );
  const takeFile = async (file) => {
    if (!next.contact && !next.redo) {
      say("First click the object where this recording was struck.", { name: "take", bad: true });
      return;
    }
    if (!(await looksLikeWav(file))) {
      const words = `${file.name}: expected a WAV file, found another kind. Save the sound as WAV and attach it again.`;
      say(words, { name: "take", bad: true });
      return;
    }
    await judge(file);
  };
  const attach = filePicker("Attach a WAV file …", ".wav,audio/wav", takeFile);

  /** Show what a recording is worth before it is kept. It is kept in the browser from the first moment. */
  const judge = async (blob) => {
    if (take) await outbox.remove(take.key);
    const { contact, direction, redo } = next;
    take = { key: newKey(), blob, contact, direction, redo, kept: false };
    await outbox.put(take);
    await showTake();
  };
  const showTake = async () => {
    const { blob } = take;
    const canvas = element("canvas", { className: "waveform", role: "img", "aria-label": "The recording" });
    const verdict = element("div", {}, element("p", { className: "faint" }, "Measuring …"));
    const address = URL.createObjectURL(blob);
    judged.hidden = false;
    judged.replaceChildren(
      element("h2", {}, "This recording"),
      canvas,
      verdict,
      element(
        "div",
        { className: "row" },
        button(take.redo ? "Put it in place" : "Keep it", keep, { className: "main" }),
        button("Redo", drop),
        listenButton(() => address),
      ),
    );
    const shown = take;
    try {
      const report = await server.checkStrike(blob);
      if (take !== shown) return;
      verdict.replaceChildren(measures(report));
      await drawTake(canvas, blob, report.onset_seconds).catch(() => {});
    } catch (error) {
      verdict.replaceChildren(element("p", { className: "warning" }, error.message));
      if (error.unreachable) verdict.append(button("Measure again", showTake, { className: "small" }));
    }
  };
  const drop = async () => {
    await outbox.remove(take.key);
    take = null;
    judged.hidden = true;
    record.focus();
  };
  const keep = async () => {
    const kept = { ...take, kept: true };
    take = null;
    judged.hidden = true;
    await outbox.put(kept);
    next.redo = null;
    setPlace(null, null);
    await send();
  };

  // Send, and send again

  let [sending, timer] = [false, null];
  const send = async () => {
    if (sending) return;
    sending = true;
    clearTimeout(timer);
    for (const entry of outbox.entries.filter(({ kept, refused }) => kept && !refused)) {
      try {
        if (entry.redo) await server.redoStrike(entry.redo, entry.blob, entry);
        else await server.addStrike(entry.blob, entry);
        await outbox.remove(entry.key);
        unsay("outbox");
      } catch (error) {
        if (error.unreachable || error.status >= 500) {
          const safe = outbox.lasting ? "kept in this browser, even if you close the page" : "kept in this open page";
          say(`The recording is not lost: it is ${safe}, and sent again until the server answers.`, { name: "outbox" });
          timer = setTimeout(send, RETRY_MS);
          break;
        }
        await outbox.put({ ...entry, refused: error.message });
      }
    }
    sending = false;
    showWaiting();
    await refresh();
  };
  const showWaiting = () => {
    const entries = outbox.entries.filter(({ kept }) => kept);
    waiting.replaceChildren(
      ...entries.map((entry) =>
        element(
          "div",
          { className: "group" },
          element(
            "p",
            { className: entry.refused ? "warning" : "faint" },
            entry.refused ? `Not taken: ${entry.refused}` : "A recording waits for the server …",
          ),
          element(
            "div",
            { className: "row" },
            button("Send again", () => outbox.put({ ...entry, refused: undefined }).then(send), { className: "small" }),
            listenButton(() => URL.createObjectURL(entry.blob)),
            button("Throw away", () => outbox.remove(entry.key).then(showWaiting), { className: "small" }),
          ),
        ),
      ),
    );
  };

  // What there is

  const refresh = async () => {
    try {
      capture = await server.capture();
      unsay("capture");
    } catch (error) {
      if (!error.unreachable) say(error.message, { name: "capture", bad: true });
      return;
    }
    showStrikes();
  };
  const showStrikes = () => {
    const { strikes } = capture;
    count.textContent = strikes.length === 1 ? "1 strike" : `${strikes.length} strikes`;
    list.hidden = strikes.length === 0;
    list.replaceChildren(...strikes.map(strikeItem));
    problems.replaceChildren(
      ...(capture.problems ?? []).map((words) => element("p", { className: "warning" }, words)),
    );
    reconstruction.setReady(strikes.length, capture.ready);
    if (!studio.view) return;
    for (const name of [...studio.view.marks.keys()]) if (name.startsWith("strike-")) studio.view.unmark(name);
    for (const { file, contact } of strikes.filter((strike) => strike.contact)) {
      const dot = button("", () => highlight(file), { className: "dot", tabIndex: -1, title: file });
      const { normal } = studio.view.contactAt(contact);
      studio.view.mark(`strike-${file}`, element("div", { className: "mark" }, dot), contact, normal);
    }
  };
  const highlight = (file) => {
    for (const item of list.children) {
      item.classList.toggle("chosen", item.dataset.file === file);
      if (item.dataset.file === file) item.scrollIntoView({ block: "nearest" });
    }
  };
  const strikeItem = (strike) => {
    const redo = () => {
      next.redo = strike.file;
      setPlace(strike.contact, strike.direction);
      record.focus();
    };
    const remove = async () => {
      // What is taken out is gone from the table: ask first.
      if (!confirm(`Take ${strike.file} out of the capture?`)) return;
      await attempt(() => server.removeStrike(strike.file), "strike");
      await refresh();
    };
    const peak = strike.peak_db === null || strike.peak_db === undefined ? "" : ` ${strike.peak_db.toFixed(1)} dB`;
    const item = element(
      "li",
      { "data-file": strike.file },
      button(`${strike.file}${peak}`, () => highlight(strike.file), { className: "grow" }),
      listenButton(() => `capture/strikes/${strike.file.split("/").map(encodeURIComponent).join("/")}`),
      button("Redo", redo, { className: "small", "aria-label": `Record ${strike.file} again` }),
      button("×", remove, { className: "small", "aria-label": `Take ${strike.file} out` }),
      ...(strike.warnings ?? []).map((words) => element("p", { className: "warning" }, words)),
    );
    return item;
  };

  window.addEventListener("online", send);
  const sheet = element(
    "section",
    {},
    element(
      "div",
      { className: "group" },
      element("h2", {}, "1. Where"),
      where,
      place,
      element("div", { className: "row" }, stopRedo),
    ),
    element(
      "div",
      { className: "group" },
      element("h2", {}, "2. Record"),
      element("div", { className: "row" }, record, attach),
      level,
      heard,
      judged,
      waiting,
    ),
    element("div", { className: "group" }, count, list, problems, element("small", {}, `Folder: ${capture.folder}`)),
    reconstruction.element,
  );
  showTarget();
  showStrikes();
  studio.addEventListener("view", showStrikes);
  // A recording that an earlier page made and had not kept is shown again.
  const left = outbox.entries.find(({ kept }) => !kept);
  if (left) {
    take = left;
    next.redo = left.redo;
    setPlace(left.contact, left.direction);
    await showTake();
  }
  showWaiting();
  if (outbox.entries.some(({ kept }) => kept)) send();
  return {
    element: sheet,
    take: takeFile,
    choose: ({ place: contact, normal }) => {
      next.redo = null;
      setPlace(contact, inward(normal));
    },
  };
}

/** A blow goes into the surface. */
const inward = (normal) => normal?.map((value) => -value) ?? null;
