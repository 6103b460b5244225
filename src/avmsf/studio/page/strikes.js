/** The blows that were measured: marked on the object, each to be heard beside the model's sound. */

import { attempt, button, element, group } from "./dom.js";
import { PointGrid } from "./nearest.js";
import { soundSpectrum } from "./spectrum.js";
import { SpectrumView } from "./spectrumview.js";

const PAUSE_SECONDS = 0.25;
const LONGEST_SECONDS = 2.5;

export function measuredStrikes(studio) {
  const list = element("ul", { className: "listing" });
  const shown = element("input", { type: "checkbox", checked: true });
  const box = group(
    element("h2", {}, "Recorded impacts"),
    element("small", {}, "Choose one to play its recording, then the model at the same contact."),
    list,
    element("label", { className: "check" }, shown, "Show them on the object"),
  );
  const comparison = new Comparison(studio);
  let strikes = [];

  const choose = (place) => {
    [...list.children].forEach((item, at) => item.classList.toggle("chosen", at === place));
    for (const dot of document.querySelectorAll(".mark .dot[data-strike]"))
      dot.classList.toggle("chosen", Number(dot.dataset.strike) === place);
    return strikes[place];
  };
  const play = (place, what) => attempt(() => comparison[what](choose(place)), "strike");

  const mark = () => {
    studio.view?.unmarkAll("strike-");
    if (!studio.view || !shown.checked) return;
    strikes.forEach(({ name, contact }, place) => {
      const title = `${name}: recording, then model`;
      const properties = { className: "dot", tabIndex: -1, title, "data-strike": place };
      studio.view.markDot(`strike-${place}`, button("", () => play(place, "both"), properties), contact);
    });
  };
  shown.addEventListener("change", mark);

  const showAll = () => {
    strikes = studio.bundle.manifest.strikes ?? [];
    box.hidden = strikes.length === 0;
    list.replaceChildren(
      ...strikes.map((strike, place) =>
        element(
          "li",
          {},
          button(strike.name, () => play(place, "both"), { className: "grow", title: "Recording, then model" }),
          button("Recording", () => play(place, "recording"), { className: "small" }),
          button("Model", () => play(place, "model"), { className: "small" }),
        ),
      ),
    );
    mark();
  };
  studio.on("bundle view", showAll);
  return box;
}

/** Recording and model of one strike, to hear one after the other and to see over each other; one strike at a time. */
class Comparison {
  #buffers = new Map();
  #serial = 0;
  #source = null;
  #timer = null;

  constructor(studio) {
    this.studio = studio;
    studio.on("bundle", () => {
      this.#begin();
      this.#buffers.clear();
      this.grid = new PointGrid(studio.bundle.tensors.points);
    });
  }

  row(strike) {
    return this.grid.nearest(...strike.contact)[0].row;
  }

  async recording(strike) {
    const isLast = this.#begin();
    this.#expectSound();
    const buffer = await this.#buffer(strike);
    if (isLast()) this.#play(strike, buffer);
  }

  async model(strike) {
    this.#begin();
    this.#expectSound();
    // As the recorded blow was: no harder, no softer.
    this.studio.strike(this.row(strike), { force: 1, contactTime: null });
  }

  async both(strike) {
    const isLast = this.#begin();
    const { studio } = this;
    this.#expectSound();
    const buffer = await this.#buffer(strike);
    if (!isLast()) return;
    const row = this.row(strike);
    const length = Math.min(buffer.duration, LONGEST_SECONDS);
    this.#play(strike, buffer);
    this.#timer = setTimeout(() => this.#strikeModel(row), 1000 * (length + PAUSE_SECONDS));
    const model = await studio.engine.renderOffline([{ row, force: 1, ...this.#mallet }], length);
    if (!isLast()) return;
    const { sampleRate } = studio.bundle.manifest;
    const part = buffer.getChannelData(0).subarray(0, Math.round(length * buffer.sampleRate));
    studio.spectra.compare(
      { levels: soundSpectrum(part, buffer.sampleRate, SpectrumView.range) },
      { levels: soundSpectrum(model, sampleRate, SpectrumView.range) },
    );
    this.#tell(strike, "recording and model");
  }

  /** End what the one before still plays or was going to; gives whether none has begun since. */
  #begin() {
    this.#source?.stop();
    this.#source = null;
    clearTimeout(this.#timer);
    const serial = ++this.#serial;
    return () => serial === this.#serial;
  }

  /** Strike the model after a recording: its decay is drawn from its own beginning, the spectra of both stay. */
  #strikeModel(row) {
    const { engine, spectra } = this.studio;
    const { compared } = spectra;
    engine.strike(row, { force: 1, ...this.#mallet });
    spectra.struck(row, 1, this.#mallet);
    if (compared) spectra.compare(compared.recording, compared.model);
  }

  /** What the model is struck with: as the recorded blow was. */
  get #mallet() {
    return { contactTime: 0, shape: this.studio.pulse };
  }

  /** Play a recording, with the model's lines of its own contact beside it from the moment at which it begins. */
  #play(strike, buffer) {
    const { engine, spectra } = this.studio;
    this.#source = engine.play(buffer);
    spectra.struck(this.row(strike), 1, this.#mallet);
    this.#tell(strike, "recording");
  }

  #tell({ name }, what) {
    document.getElementById("blow-facts").textContent = `${name}: ${what}`;
  }

  #expectSound() {
    if (!this.studio.engine) throw new Error("This browser plays no sound, so there is nothing to compare.");
  }

  async #buffer(strike) {
    if (!this.#buffers.has(strike)) {
      const bytes = await this.studio.bundle.read(strike.sound);
      const rate = this.studio.bundle.manifest.sampleRate;
      try {
        this.#buffers.set(strike, await new OfflineAudioContext(1, 1, rate).decodeAudioData(bytes));
      } catch {
        throw new Error(`${strike.sound}: expected a WAV file, got data that the browser cannot read.`);
      }
    }
    return this.#buffers.get(strike);
  }
}
