/** The tab that edits: sliders heard at once, undo, saved as a new field. */

import { Changes } from "./changes.js";
import { button, element, group, line, say, section, Slider } from "./dom.js";
import { leadGroup } from "./lead.js";
import { server } from "./server.js";

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

/** `load()` fetches the server's present bundle and takes it. */
export function editSheet(studio, load) {
  const single = new Map();
  const onInput = () => changes.moved();
  const makeSliders = (which, onInput) =>
    Object.fromEntries(
      Object.entries(which).map(([name, [words, options]]) => [name, new Slider(words, { ...options, onInput })]),
    );
  const sliders = makeSliders(WHOLE, onInput);
  const modeSliders = makeSliders(SINGLE, () => {
    const values = Object.fromEntries(Object.entries(modeSliders).map(([name, slider]) => [name, slider.value]));
    single.set(studio.bank, values);
    changes.moved();
  });
  const select = (none, onchange) =>
    element(
      "select",
      { onchange },
      element("option", { value: "" }, none),
      ...studio.live.materials.map((name) => element("option", { value: name }, name)),
    );
  // What the object is of counts where it shall be of another material or size, and changes nothing by itself.
  const changesMaterial = () => to.value !== "" || sliders.size.value !== sliders.size.rest;
  const from = select("inferred", () => changesMaterial() && onInput());
  const to = select("unchanged", onInput);
  const remarks = element("div", { className: "group", "aria-live": "polite" });
  const busy = element("progress", { hidden: true, "aria-label": "Editing" });
  const asked = () => ({
    material: changesMaterial() && (from.value || to.value) ? { from: from.value || null, to: to.value || null } : null,
    ...Object.fromEntries(Object.entries(sliders).map(([name, slider]) => [name, slider.value])),
    modes: [...single].filter(([, values]) => !atRest(values)).map(([mode, values]) => ({ mode, ...values })),
  });

  const tell = (words) => remarks.replaceChildren(...words.map((word) => element("p", { className: "faint" }, word)));
  /** Put the sliders where the server has them. */
  const takeSliders = () => {
    const there = studio.live.sliders ?? {};
    for (const [name, slider] of Object.entries(sliders)) slider.set(there[name] ?? slider.rest);
    from.value = there.material?.from ?? "";
    to.value = there.material?.to ?? "";
    single.clear();
    for (const { mode, ...values } of there.modes ?? []) single.set(mode, values);
    showMode();
  };
  const changes = new Changes(studio, {
    load,
    wish: asked,
    takeSliders,
    onBusy: (yes) => {
      busy.hidden = !yes;
    },
  });

  // What changes the field from under the sliders holds them until it is done; work of minutes holds the buttons too.
  const held = { moments: 0, minutes: 0 };
  const showHolds = () => {
    const all = [...Object.values(sliders), ...Object.values(modeSliders)].map(({ input }) => input);
    for (const control of [...all, from, to]) control.disabled = held.moments + held.minutes > 0;
    for (const control of [undo, reset, save]) control.disabled = held.minutes > 0;
    undo.disabled ||= !studio.live?.undo;
  };
  const hold = async (work, time = "moments") => {
    held[time] += 1;
    showHolds();
    try {
      await work();
    } finally {
      held[time] -= 1;
      showHolds();
    }
  };

  const undo = button("Undo", () =>
    hold(() =>
      changes.queue(async () => {
        if (!(await changes.settle())) return;
        const again = () => undo.click();
        const answer = await changes.ask(() => server.undo(studio.revision), { again, mine: false });
        if (answer && (await changes.show(answer, { sliders: true }))) studio.strikeAgain();
      }),
    ),
  );
  const reset = button("Reset all", () => {
    Object.values(sliders).forEach((slider) => slider.reset());
    [from.value, to.value] = ["", ""];
    single.clear();
    showMode();
    changes.moved();
  });

  const name = element("input", { type: "text", "aria-label": "Name of the new field", placeholder: "new-name" });
  const save = button("Save as", async () => {
    const wanted = name.value.trim();
    if (!wanted) {
      say("Enter a name for the new field.", { name: "edit", bad: true });
      name.focus();
      return;
    }
    await hold(() =>
      changes.queue(async () => {
        if (!(await changes.settle())) return;
        const again = () => save.click();
        const answer = await changes.ask(() => server.save(studio.revision, wanted), { again });
        if (!answer) return;
        if (answer.revision !== undefined) await changes.show(answer, { sliders: true });
        say(`Saved: ${answer.file}`, { name: "saved" });
      }),
    );
  });

  const modeTitle = element("p", { className: "faint" });
  const modeBox = group(...Object.values(modeSliders).map((slider) => slider.element));
  const showMode = () => {
    const { mode } = studio;
    modeBox.hidden = mode === null;
    const changes = [...single.values()].filter((values) => !atRest(values)).length;
    const others = changes ? ` Changed modes: ${changes}.` : "";
    modeTitle.textContent =
      (mode === null
        ? "Choose a mode in the tab Modes."
        : `Mode ${studio.bank}, now at ${studio.modes.frequency(mode).toFixed(1)} Hz.`) + others;
    const values = single.get(studio.bank) ?? {};
    for (const [which, slider] of Object.entries(modeSliders)) {
      // A muted mode has no level: null.
      slider.set(values[which] === null ? SINGLE[which][1].low : (values[which] ?? slider.rest));
    }
  };
  studio.on("mode", showMode);
  studio.on("bundle", () => {
    showHolds();
    tell(studio.live?.remarks ?? []);
  });

  const sheet = section(
    group(
      element("h2", {}, "Material"),
      // The server's messages use this label.
      element("label", { className: "choice" }, "Present material", from),
      element("label", { className: "choice" }, "New material", to),
    ),
    group(...Object.values(sliders).map((slider) => slider.element)),
    element("details", {}, element("summary", {}, "A single mode"), modeTitle, modeBox),
    line(undo, reset),
    busy,
    remarks,
  );
  if (studio.can("like")) sheet.append(leadGroup(studio, changes, hold));
  if (studio.can("save")) sheet.append(group(element("h2", {}, "Save"), line(name, save)));
  takeSliders();
  return { element: sheet };
}

const atRest = ({ db, pitch, decay }) => db === 0 && pitch === 1 && decay === 1;
