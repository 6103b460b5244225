/** The tab with which one plays: force, mallet, and the recorded impacts beside the model's sound. */

import { decode } from "./audio.js";
import { attempt, button, choices, element, group, line, seconds, section, Slider, smallButton } from "./dom.js";
import { renderOffline } from "./sound.js";

/** Seconds of contact; null for the recorded hammer. */
const MALLETS = [
  [null, "As recorded"],
  [0.0002, "Steel"],
  [0.001, "Wood"],
  [0.004, "Rubber"],
  [0.012, "Felt"],
];
const PAUSE_SECONDS = 0.25;
const MAX_COMPARED_SECONDS = 2.5;

export function strikeTab(studio) {
  const relative = studio.bundle.manifest.perNewton ? "" : ", × a recorded impact";
  const force = new Slider(`Force of a click${relative}`, {
    low: 0.05,
    high: 20,
    value: 1,
    words: (value) => studio.forceText(value),
    onInput: (value) => {
      studio.force = value;
    },
  });
  const contactTime = new Slider("Contact time", {
    low: 0.00005,
    high: 0.03,
    value: 0.001,
    words: seconds,
    onInput: (value) => {
      studio.contactTime = value;
      for (const input of mallet.querySelectorAll("input")) input.checked = false;
    },
  });
  const mallet = choices("mallet", "Mallet", MALLETS, null, (time) => {
    studio.contactTime = time;
    pulse.hidden = time === null;
    if (time !== null) contactTime.set(time);
    if (studio.row !== null) studio.strike(studio.row);
  });
  const shape = element(
    "select",
    { "aria-label": "Shape of the force over the contact time", onchange: () => (studio.pulse = shape.value) },
    element("option", { value: "half-sine" }, "force: half-sine"),
    element("option", { value: "hertz" }, "force: Hertzian contact"),
  );
  const pulse = element("div", { className: "group", hidden: true }, contactTime.element, shape);
  const volume = new Slider("Volume", {
    low: 0.05,
    high: 4,
    value: 1,
    words: (value) => `${Math.round(100 * value)} %`,
    onInput: (value) => studio.engine?.setVolume(value),
  });
  const atPress = element("input", { type: "checkbox" });
  const sheet = section(
    group(
      force.element,
      element("small", {}, "Hold a click longer to strike up to ten times harder; a pen's pressure counts too."),
    ),
    group(element("h2", {}, "Mallet"), mallet, pulse),
    element("label", { className: "check" }, atPress, "Sound at the press, without waiting for the release"),
    line(
      button("Strike again", () => studio.strikeAgain()),
      button("Strike at random", () => studio.strike(Math.floor(Math.random() * studio.contacts.count))),
    ),
    recordedImpacts(studio),
    volume.element,
  );
  return { element: sheet, atPress: () => atPress.checked };
}

/** The recorded impacts: marked on the object, each to be played beside the model's sound. */
function recordedImpacts(studio) {
  const list = element("ul", { className: "listing" });
  const shown = element("input", { type: "checkbox", checked: true, onchange: () => mark() });
  const box = group(
    element("h2", {}, "Recorded impacts"),
    element("small", {}, "Choose one to play its recording, then the model at the same contact."),
    list,
    element("label", { className: "check" }, shown, "Show them on the object"),
  );
  const comparison = new Comparison(studio);
  let impacts = [];

  const play = (index, what) => {
    [...list.children].forEach((item, at) => item.classList.toggle("chosen", at === index));
    for (const dot of document.querySelectorAll(".mark .dot[data-impact]"))
      dot.classList.toggle("chosen", Number(dot.dataset.impact) === index);
    return attempt(() => comparison[what](impacts[index]), "strike");
  };
  const mark = () => {
    studio.view?.unmarkAll("impact-");
    if (!studio.view || !shown.checked) return;
    impacts.forEach(({ name, contact }, index) => {
      const title = `${name}: recording, then model`;
      const properties = { className: "dot", tabIndex: -1, title, "data-impact": index };
      studio.view.markDot(`impact-${index}`, button("", () => play(index, "both"), properties), contact);
    });
  };
  studio.on("bundle view", () => {
    impacts = studio.bundle.manifest.strikes ?? [];
    box.hidden = impacts.length === 0;
    list.replaceChildren(
      ...impacts.map(({ name }, index) =>
        element(
          "li",
          {},
          button(name, () => play(index, "both"), { className: "grow", title: "Recording, then model" }),
          smallButton("Recording", () => play(index, "recording")),
          smallButton("Model", () => play(index, "model")),
        ),
      ),
    );
    mark();
  });
  return box;
}

/** Recording and model of one impact, to play one after the other and to show over each other; one impact at a time. */
class Comparison {
  #serial = 0;
  #source = null;
  #timer = null;

  constructor(studio) {
    this.studio = studio;
    studio.on("bundle", () => this.#begin());
  }

  /** Play the recording, and draw the model's modes of its contact; gives it, or null if another was chosen since. */
  async recording(impact) {
    const serial = this.#begin();
    const buffer = await this.#decode(impact);
    if (serial !== this.#serial) return null;
    const { engine, spectra } = this.studio;
    this.#source = engine.play(buffer);
    spectra.struck(this.#row(impact), 1, this.#mallet);
    this.#say(impact, "recording");
    return buffer;
  }

  model(impact) {
    this.#begin();
    // As hard as the recorded impact.
    this.studio.strike(this.#row(impact), { force: 1, contactTime: null });
  }

  async both(impact) {
    const buffer = await this.recording(impact);
    if (!buffer) return;
    const { spectra, bundle } = this.studio;
    const serial = this.#serial;
    const length = Math.min(buffer.duration, MAX_COMPARED_SECONDS);
    this.#timer = setTimeout(() => this.#strikeModel(impact), 1000 * (length + PAUSE_SECONDS));
    const model = await renderOffline(bundle, [{ row: this.#row(impact), ...this.#mallet }], length);
    if (serial !== this.#serial) return;
    const { sampleRate } = buffer;
    const samples = buffer.getChannelData(0).subarray(0, Math.round(length * sampleRate));
    spectra.compare({ samples, sampleRate }, { samples: model, sampleRate: bundle.manifest.sampleRate });
    this.#say(impact, "recording and model");
  }

  /** End what is played or was going to be; gives the number of what begins. */
  #begin() {
    this.#source?.stop();
    this.#source = null;
    clearTimeout(this.#timer);
    return ++this.#serial;
  }

  #row({ contact }) {
    return this.studio.contacts.nearest(contact).row;
  }

  /** What the model is struck with: as the recorded impact was. */
  get #mallet() {
    return { contactTime: 0, shape: this.studio.pulse };
  }

  /** Strike the model after a recording: its decay is drawn from its own beginning, the spectra of both stay. */
  #strikeModel(impact) {
    const { engine, spectra } = this.studio;
    const { compared } = spectra;
    engine.strike(this.#row(impact), this.#mallet);
    spectra.struck(this.#row(impact), 1, this.#mallet);
    spectra.compared = compared;
  }

  #say({ name }, what) {
    document.getElementById("strike-facts").textContent = `${name}: ${what}`;
  }

  async #decode({ sound }) {
    const { engine, bundle } = this.studio;
    if (!engine) throw new Error("This browser plays no sound, so there is nothing to compare.");
    const bytes = await bundle.read(sound);
    return decode(bytes, bundle.manifest.sampleRate).catch(() => {
      throw new Error(`${sound}: expected a WAV file, got data that the browser cannot read.`);
    });
  }
}
