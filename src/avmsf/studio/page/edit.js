/** The tab that edits: sliders that are played at once, guided edits, undo, saved as a new field. */

import { server } from "./api.js";
import { Changes } from "./changes.js";
import { button, element, faint, filePicker, group, line, say, section, Slider } from "./dom.js";
import { JobProgress } from "./jobs.js";

const factor = (value) => `× ${value.toPrecision(3)}`;
const decibel = (value) => `${value > 0 ? "+" : ""}${value.toFixed(1)} dB`;
const PITCH = ["Pitch", { low: 0.5, high: 2, value: 1, words: factor }];
const DECAY = ["Decay time", { low: 0.1, high: 10, value: 1, words: factor }];
const even = (low, high) => ({ low, high, value: 0, words: decibel, even: true, steps: 240 });
const OF_ALL = {
  size: ["Size", { low: 0.25, high: 4, value: 1, words: factor }],
  pitch: PITCH,
  decay: DECAY,
  brightness: ["Brightness, each octave", even(-12, 12)],
};
const OF_ONE = { db: ["Level", even(-40, 20)], pitch: PITCH, decay: DECAY };

/** `load()` fetches the server's current bundle and takes it. */
export function editTab(studio, load) {
  /** By the mode's row in the bank: the values of the sliders for one mode. */
  const ofModes = new Map();
  const changedModes = () => [...ofModes].filter(([, { db, pitch, decay }]) => db !== 0 || pitch !== 1 || decay !== 1);
  const makeSliders = (sliders, onInput) =>
    Object.fromEntries(
      Object.entries(sliders).map(([name, [words, options]]) => [name, new Slider(words, { ...options, onInput })]),
    );
  const valuesOf = (sliders) => Object.fromEntries(Object.entries(sliders).map(([name, { value }]) => [name, value]));
  const onInput = () => changes.moved();
  const sliders = makeSliders(OF_ALL, onInput);
  const modeSliders = makeSliders(OF_ONE, () => {
    ofModes.set(studio.bank, valuesOf(modeSliders));
    changes.moved();
  });
  const option = (name, words = name) => element("option", { value: name }, words);
  const select = (none, onchange) =>
    element("select", { onchange }, option("", none), ...studio.live.materials.map((name) => option(name)));
  // The present material counts where the object gets another material or size, and changes nothing by itself.
  const changesMaterial = () => to.value !== "" || sliders.size.value !== sliders.size.rest;
  const from = select("inferred", () => changesMaterial() && onInput());
  const to = select("unchanged", onInput);
  const remarks = element("div", { className: "group", "aria-live": "polite" });
  const busy = element("progress", { hidden: true, "aria-label": "Editing" });
  const changes = new Changes(studio, {
    load,
    request: () => ({
      material: changesMaterial() ? { from: from.value || null, to: to.value || null } : null,
      ...valuesOf(sliders),
      modes: changedModes().map(([mode, values]) => ({ mode, ...values })),
    }),
    takeSliders: () => setSliders(studio.live.sliders ?? {}),
    busy,
  });
  const setSliders = ({ material, modes = [], ...values }) => {
    for (const [name, slider] of Object.entries(sliders)) slider.set(values[name] ?? slider.rest);
    from.value = material?.from ?? "";
    to.value = material?.to ?? "";
    ofModes.clear();
    for (const { mode, ...changed } of modes) ofModes.set(mode, changed);
    showMode();
  };

  // What changes the field from under the sliders disables them until it is done.
  let running = 0;
  const enable = () => {
    const inputs = [...Object.values(sliders), ...Object.values(modeSliders)].map(({ input }) => input);
    for (const control of [...inputs, from, to, undo, reset, save]) control.disabled = running > 0;
    undo.disabled ||= !studio.live?.undo;
  };
  const hold = async (work) => {
    running += 1;
    enable();
    await work();
    running -= 1;
    enable();
  };
  /** Once the server has what the sliders ask for: do what changes the field, and then `take` its answer. */
  const change = (action, again, take) =>
    hold(() =>
      changes.queue(async () => {
        const answer = (await changes.settle()) && (await changes.ask(action, { again }));
        if (answer) await take(answer);
      }),
    );

  const undo = button("Undo", () =>
    change(() => server.undo(studio.revision), () => undo.click(), async (answer) => {
      if (await changes.show(answer, { sliders: true })) studio.strikeAgain();
    }),
  );
  const reset = button("Reset all", () => {
    setSliders({});
    changes.moved();
  });
  const name = element("input", { type: "text", "aria-label": "Name of the new field", placeholder: "new-name" });
  const save = button("Save as", () =>
    change(() => server.save(studio.revision, name.value.trim()), () => save.click(), async (answer) => {
      await changes.show(answer, { sliders: true });
      say(`Saved: ${answer.file}`, { name: "saved" });
    }),
  );

  const modeTitle = faint("");
  const modeBox = group(...Object.values(modeSliders).map((slider) => slider.element));
  const showMode = () => {
    const { mode } = studio;
    modeBox.hidden = mode === null;
    const count = changedModes().length;
    const title =
      mode === null
        ? "Choose a mode in the tab Modes."
        : `Mode ${studio.bank + 1}, now at ${studio.modes.frequency(mode).toFixed(1)} Hz.`;
    modeTitle.textContent = title + (count ? ` Changed modes: ${count}.` : "");
    const values = ofModes.get(studio.bank) ?? {};
    for (const [which, slider] of Object.entries(modeSliders)) {
      // A muted mode has no level: null.
      slider.set(values[which] === null ? OF_ONE[which][1].low : (values[which] ?? slider.rest));
    }
  };
  studio.on("mode", showMode);
  studio.on("bundle", () => {
    enable();
    remarks.replaceChildren(...(studio.live?.remarks ?? []).map(faint));
  });

  const sheet = section(
    group(
      element("h2", {}, "Material"),
      element("label", { className: "choice" }, studio.live.oldMaterial, from),
      element("label", { className: "choice" }, "New material", to),
    ),
    group(...Object.values(sliders).map((slider) => slider.element)),
    element("details", {}, element("summary", {}, "A single mode"), modeTitle, modeBox),
    line(undo, reset),
    busy,
    remarks,
  );
  if (studio.can("like")) sheet.append(guidedEdit(studio, changes, hold));
  if (studio.can("save")) sheet.append(group(element("h2", {}, "Save"), line(name, save)));
  setSliders(studio.live.sliders ?? {});
  return { element: sheet };
}

/** Optimize the sound towards a recording: minutes of work, during which the sliders rest. */
function guidedEdit(studio, changes, hold) {
  const progress = new JobProgress();
  const start = (ask) =>
    hold(async () => {
      progress.begin("Starting …");
      const again = () => start(ask);
      const started = await changes.queue(async () => (await changes.settle()) && changes.ask(ask, { again }));
      if (started) await follow(started.job);
      else progress.end();
    });
  const follow = async (job) => {
    const steps = [];
    const last = await progress.follow(job, (message) => {
      // Other stages have no loss, and a step without a number says so.
      if (Number.isFinite(message.loss)) steps.push(message);
    });
    if (last.error) say(last.error, { name: "edit", bad: true });
    else if (last.revision !== undefined && (await changes.queue(() => changes.show(last, { sliders: true })))) {
      studio.strikeAgain();
      say(summaryOf(steps), { name: "guided" });
    }
  };

  const byRecording = (file) => start(() => server.guide(studio.revision, file));
  const picker = filePicker("Towards a recording …", ".wav,audio/wav", byRecording);
  // One that was running before the page was loaded goes on.
  if (studio.live.jobKind === "lead") hold(() => follow(studio.live.job));
  return group(element("h2", {}, "Guided edit"), line(picker, progress.stop), progress.bar, progress.stage);
}

/** The result of an optimization's steps, {loss, pitch} each. */
function summaryOf(steps) {
  if (!steps.length) return "Guided edit finished.";
  const [first, last] = [steps[0], steps.at(-1)];
  const losses = `${first.loss.toPrecision(2)} to ${last.loss.toPrecision(2)}`;
  return `Guided edit finished: pitch × ${last.pitch.toPrecision(3)}, loss from ${losses}. Undo reverts it.`;
}
