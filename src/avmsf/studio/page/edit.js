/** The tab that edits: sliders heard at once, undo, saved as a new field. */

import { button, element, filePicker, say, Slider, unsay } from "./dom.js";
import { server } from "./server.js";

const SETTLED_MS = 200;
const factor = (value) => `× ${value.toPrecision(3)}`;
const decibel = (value) => `${value > 0 ? "+" : ""}${value.toFixed(1)} dB`;
const WHOLE = {
  size: ["Size", { low: 0.25, high: 4, value: 1, words: factor }],
  pitch: ["Pitch", { low: 0.5, high: 2, value: 1, words: factor }],
  decay: ["Decay time", { low: 0.1, high: 10, value: 1, words: factor }],
  brightness: [
    "Brightness, each octave",
    { low: -12, high: 12, value: 0, words: decibel, even: true, steps: 240 },
  ],
};
const SINGLE = {
  db: ["Level", { low: -40, high: 20, value: 0, words: decibel, even: true, steps: 240 }],
  pitch: ["Pitch", { low: 0.5, high: 2, value: 1, words: factor }],
  decay: ["Decay time", { low: 0.1, high: 10, value: 1, words: factor }],
};
const MATERIALS = ["ceramic", "glass", "wood", "plastic", "iron", "polycarbonate", "steel"];

/** `reload()` fetches the server's present bundle and takes it. */
export function editSheet(studio, reload) {
  const single = new Map();
  const onInput = () => changed();
  const makeSliders = (which, onInput) =>
    Object.fromEntries(
      Object.entries(which).map(([name, [words, options]]) => [name, new Slider(words, { ...options, onInput })]),
    );
  const sliders = makeSliders(WHOLE, onInput);
  const modeSliders = makeSliders(SINGLE, () => {
    const values = Object.fromEntries(Object.entries(modeSliders).map(([name, slider]) => [name, slider.value]));
    single.set(studio.bank, values);
    changed();
  });
  const names = studio.live.materials ?? MATERIALS;
  const select = (label, none) =>
    element(
      "select",
      { "aria-label": label, onchange: onInput },
      element("option", { value: "" }, none),
      ...names.map((name) => element("option", { value: name }, name)),
    );
  const from = select("Material it is of", "by its sound");
  const to = select("New material", "as it is");
  const remarks = element("div", { className: "group", "aria-live": "polite" });
  const busy = element("progress", { hidden: true, "aria-label": "Editing" });
  const asked = () => ({
    material: to.value ? { from: from.value || null, to: to.value } : null,
    ...Object.fromEntries(Object.entries(sliders).map(([name, slider]) => [name, slider.value])),
    modes: [...single].filter(([, values]) => !atRest(values)).map(([mode, values]) => ({ mode, ...values })),
  });

  // One request at a time: while one runs, the newest wish waits and older ones are forgotten.
  let [running, waiting, timer] = [false, false, null];
  const changed = () => {
    clearTimeout(timer);
    timer = setTimeout(send, SETTLED_MS);
  };
  const send = async () => {
    if (running) {
      waiting = true;
      return;
    }
    running = true;
    const answer = await attemptEdit(() => server.edit(studio.revision, asked()), send);
    if (answer) {
      await show(answer);
      studio.strike(studio.row ?? studio.modes.loudestRow);
    }
    running = false;
    if (waiting) {
      waiting = false;
      await send();
    }
  };
  const tell = (words) => remarks.replaceChildren(...words.map((word) => element("p", { className: "faint" }, word)));
  const show = async ({ revision }) => {
    studio.revision = revision;
    await reload();
  };

  /** Do what changes the field; where another tab was faster, nothing is overwritten, and the user chooses. */
  const attemptEdit = async (action, again) => {
    busy.hidden = false;
    try {
      const answer = await action();
      unsay("edit");
      return answer;
    } catch (error) {
      if (error.stale) {
        say(`Another tab changed this field meanwhile. ${error.message}`, {
          name: "edit",
          bad: true,
          answers: [
            ["Show its change", () => takeTheirs(error.revision)],
            ["Put mine in its place", () => ((studio.revision = error.revision), again())],
          ],
        });
      } else {
        const answers = error.unreachable ? [["Try again", again]] : [];
        say(error.message, { name: "edit", bad: true, answers });
      }
      return undefined;
    } finally {
      busy.hidden = true;
    }
  };
  const takeTheirs = async (revision) => {
    studio.revision = revision;
    await reload();
    takeSliders();
  };
  /** Put the sliders where the server has them. */
  const takeSliders = () => {
    const there = studio.live.sliders ?? {};
    for (const [name, slider] of Object.entries(sliders)) slider.set(there[name] ?? slider.rest);
    from.value = there.material?.from ?? "";
    to.value = there.material?.to ?? "";
    single.clear();
    for (const { mode, ...values } of there.modes ?? []) single.set(mode, { ...values, db: values.db ?? -40 });
    showMode();
  };

  const undo = button("Undo", async () => {
    const answer = await attemptEdit(
      () => server.undo(studio.revision),
      () => undo.click(),
    );
    if (!answer) return;
    await show(answer);
    takeSliders();
    studio.strike(studio.row ?? studio.modes.loudestRow);
  });
  const reset = button("All at rest", () => {
    Object.values(sliders).forEach((slider) => slider.reset());
    [from.value, to.value] = ["", ""];
    single.clear();
    showMode();
    changed();
  });

  const name = element("input", { type: "text", "aria-label": "Name of the new field", placeholder: "new-name" });
  const save = button("Save as", async () => {
    const wanted = name.value.trim();
    if (!wanted) {
      say("Give the new field a name first.", { name: "edit", bad: true });
      name.focus();
      return;
    }
    const answer = await attemptEdit(
      () => server.save(studio.revision, wanted),
      () => save.click(),
    );
    if (answer) say(`Saved: ${answer.file}`, { name: "saved" });
    if (answer?.revision) await show({ revision: answer.revision }).then(takeSliders);
  });

  const modeTitle = element("p", { className: "faint" });
  const modeBox = element("div", { className: "group" }, ...Object.values(modeSliders).map((slider) => slider.element));
  const showMode = () => {
    const { mode } = studio;
    modeBox.hidden = mode === null;
    const changes = [...single.values()].filter((values) => !atRest(values)).length;
    const others = changes ? ` Changed by hand: ${changes}.` : "";
    modeTitle.textContent =
      (mode === null
        ? "Choose a mode in the tab Modes."
        : `Mode ${studio.bank}, now at ${studio.modes.frequency(mode).toFixed(1)} Hz.`) + others;
    const values = single.get(studio.bank) ?? {};
    for (const [which, slider] of Object.entries(modeSliders)) slider.set(values[which] ?? slider.rest);
  };
  studio.on("mode", showMode);
  studio.on("bundle", () => {
    undo.disabled = !studio.live?.undo;
    tell(studio.live?.remarks ?? []);
  });

  const sheet = element(
    "section",
    {},
    element(
      "div",
      { className: "group" },
      element("h2", {}, "Material"),
      element("div", { className: "row" }, from, "→", to),
    ),
    element("div", { className: "group" }, ...Object.values(sliders).map((slider) => slider.element)),
    element("details", {}, element("summary", {}, "A single mode"), modeTitle, modeBox),
    element("div", { className: "row" }, undo, reset),
    busy,
    remarks,
  );
  if (studio.can("like")) sheet.append(leadGroup(studio, show));
  if (studio.can("save"))
    sheet.append(
      element("div", { className: "group" }, element("h2", {}, "Save"), element("div", { className: "row" }, name, save)),
    );
  takeSliders();
  return { element: sheet };
}

const atRest = ({ db, pitch, decay }) => db === 0 && pitch === 1 && decay === 1;

/** Lead the sound towards a recording or words: minutes of work, so with progress and a way to stop. */
function leadGroup(studio, show) {
  const progress = element("progress", { hidden: true, "aria-label": "Progress" });
  const stage = element("small", { "aria-live": "polite" });
  let job = null;
  const complain = (error) => say(error.message, { name: "edit", bad: true });
  const stop = button("Stop", () => server.cancel(job).catch(complain), { hidden: true });
  const lead = async (towards) => {
    try {
      ({ job } = await server.edit(studio.revision, towards));
    } catch (error) {
      complain(error);
      return;
    }
    [progress.hidden, stop.hidden] = [false, false];
    server.follow(job, async (message, ended) => {
      if (message.total) [progress.max, progress.value] = [message.total, message.done ?? 0];
      stage.textContent = [message.stage, message.words].filter(Boolean).join(": ");
      if (!ended) return;
      [job, progress.hidden, stop.hidden] = [null, true, true];
      if (message.error) complain(new Error(message.error));
      else if (message.revision !== undefined) {
        await show(message);
        studio.strike(studio.row ?? studio.modes.loudestRow);
      }
    });
  };
  const leadLike = async (file) => lead({ like: await base64(file) });
  const rows = [filePicker("Towards a recording …", ".wav,audio/wav", leadLike)];
  if (studio.can("words")) {
    const placeholder = "a wooden bowl is hit";
    const text = element("input", { type: "text", "aria-label": "What it should sound like", placeholder });
    rows.push(text, button("Towards these words", () => lead({ prompt: text.value })));
  }
  return element(
    "div",
    { className: "group" },
    element("h2", {}, "Lead the sound"),
    element("div", { className: "row" }, ...rows, stop),
    progress,
    stage,
  );
}

async function base64(file) {
  const bytes = new Uint8Array(await file.arrayBuffer());
  let letters = "";
  for (const byte of bytes) letters += String.fromCharCode(byte);
  return btoa(letters);
}
