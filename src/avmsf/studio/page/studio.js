/** What all parts of the page share: the field that is open, its sound and picture, and what was struck last. */

import { element, say, seconds } from "./dom.js";
import { Modes } from "./modes.js";

export class Studio extends EventTarget {
  constructor(bundle) {
    super();
    this.view = null;
    this.engine = null;
    this.spectra = null;
    this.row = null;
    this.bank = null;
    this.force = 1;
    /** Seconds the mallet stays on the object; null strikes as the recorded blows did. */
    this.contactTime = null;
    this.pulse = "half-sine";
    this.take(bundle);
  }

  /** Show and sound another bundle, such as an edited field. */
  take(bundle) {
    const modes = new Modes(bundle);
    if (!modes.sameContacts(this.modes)) this.row = null;
    this.bundle = bundle;
    this.modes = modes;
    this.revision = bundle.manifest.live?.revision ?? null;
    this.#tell("bundle");
  }

  get live() {
    return this.bundle.manifest.live;
  }

  can(ability) {
    return this.live?.abilities?.includes(ability) ?? false;
  }

  get forceUnit() {
    return this.bundle.manifest.perNewton ? " N" : " ×";
  }

  /** Strike a contact, with `factor` times the force that is set. */
  strike(row, { factor = 1, force = this.force * factor, contactTime = this.contactTime } = {}) {
    if (!this.modes.points) {
      say("This field has no contacts to strike.", { name: "strike", bad: true });
      return;
    }
    this.row = row;
    const mallet = { contactTime: contactTime ?? 0, shape: this.pulse };
    this.engine?.strike(row, { force, ...mallet });
    this.last = { row, force, contactTime };
    this.spectra?.struck(row, force, mallet);
    this.#markBlow(row);
    const where = this.view ? `contact ${row}` : `contact number ${row}`;
    const touch = contactTime === null ? "" : `, ${seconds(contactTime)}`;
    document.getElementById("blow-facts").textContent = `${where}, ${force.toPrecision(2)}${this.forceUnit}${touch}`;
    this.#tell("struck");
  }

  /** Strike where one struck last; before the first blow, where the field is loudest. */
  strikeAgain() {
    this.strike(this.row ?? this.modes.loudestRow);
  }

  #markBlow(row) {
    if (!this.view) return;
    const wave = element("div", { className: "wave" });
    const mark = element("div", { className: "mark" }, element("div", { className: "dot struck" }), wave);
    this.view.mark("blow", mark, this.view.placeOf(row), this.view.normalOf(row));
  }

  /** The mode that is chosen; null where none is, or where it is no longer heard. */
  get mode() {
    const mode = this.live?.rows ? this.live.rows.indexOf(this.bank) : (this.bank ?? -1);
    return this.bank === null || mode < 0 || mode >= this.modes.count ? null : mode;
  }

  /** What the server calls a mode: its row in the bank of the field as it was opened, unheard ones counted too. */
  bankRow(mode) {
    return this.live?.rows?.[mode] ?? mode;
  }

  /** Choose a mode, whose shape is painted on the object; null chooses none. */
  choose(mode) {
    this.bank = mode === null ? null : this.bankRow(mode);
    this.#tell("mode");
  }

  /** Paint values of the contacts, with a legend: `ends` are the words below it. Null takes the paint off. */
  paint(values, { scale, title, ends } = {}) {
    if (!this.view) {
      if (values) say("The object is not shown, so it cannot be colored.", { seconds: 6 });
      return;
    }
    this.view.paint(values, scale);
    const legend = document.getElementById("legend");
    legend.hidden = !values;
    if (!values) return;
    document.getElementById("legend-title").textContent = title;
    document.getElementById("legend-bar").style.background = scale.gradient;
    [...document.getElementById("legend-ends").children].forEach((end, place) => {
      end.textContent = ends[place];
    });
  }

  /** Call `heard` now and whenever one of these things happens: bundle, struck, mode. */
  on(names, heard) {
    for (const name of names.split(" ")) this.addEventListener(name, heard);
    heard();
  }

  #tell(name) {
    this.dispatchEvent(new Event(name));
  }
}
