/** What all parts of the page share: the field that is open, its sound and picture, and what was struck last. */

import { element, say, seconds } from "./dom.js";
import { Modes } from "./modes.js";

export class Studio extends EventTarget {
  view = null;
  engine = null;
  spectra = null;
  /** The contact that was struck last, and the bank's row of the mode that is chosen. */
  row = null;
  bank = null;
  force = 1;
  /** Seconds the mallet stays on the object; null strikes as the recorded impacts did. */
  contactTime = null;
  pulse = "half-sine";

  constructor(bundle) {
    super();
    this.take(bundle);
  }

  /** Show and sound another bundle, such as an edited field. */
  take(bundle) {
    if (!bundle.contacts.equal(this.bundle?.contacts)) this.row = null;
    this.bundle = bundle;
    this.modes = new Modes(bundle);
    this.revision = bundle.manifest.live?.revision ?? null;
    this.#notify("bundle");
  }

  get contacts() {
    return this.bundle.contacts;
  }

  get live() {
    return this.bundle.manifest.live;
  }

  can(ability) {
    return this.live?.abilities?.includes(ability) ?? false;
  }

  /** A force in words, of its ratio to an average recorded impact's. */
  forceText(force) {
    const { perNewton, backgroundForce } = this.bundle.manifest;
    return `${Number((force * (backgroundForce ?? 1)).toPrecision(2))}${perNewton ? " N" : " ×"}`;
  }

  /** Strike a contact, with `factor` times the force that is set. */
  strike(row, { factor = 1, force = this.force * factor, contactTime = this.contactTime } = {}) {
    if (!this.contacts.count) {
      say("This field has no contacts to strike.", { name: "strike", bad: true });
      return;
    }
    this.row = row;
    this.last = { row, force, contactTime };
    const mallet = { contactTime: contactTime ?? 0, shape: this.pulse };
    this.engine?.strike(row, { force, ...mallet });
    this.spectra?.struck(row, force, mallet);
    const parts = ["dot struck", "wave"].map((className) => element("div", { className }));
    const mark = element("div", { className: "mark" }, ...parts);
    this.view?.mark("struck", mark, this.contacts.position(row), this.contacts.normal(row));
    const where = this.view ? `contact ${row}` : `contact number ${row}`;
    const duration = contactTime === null ? "" : `, ${seconds(contactTime)}`;
    document.getElementById("strike-facts").textContent = `${where}, ${this.forceText(force)}${duration}`;
    this.#notify("struck");
  }

  /** Strike the last contact again; before the first strike, the one where the field is loudest. */
  strikeAgain() {
    this.strike(this.row ?? this.modes.loudestRow);
  }

  /** The mode that is chosen; null where none is, or where it is no longer audible. */
  get mode() {
    const mode = this.live?.rows ? this.live.rows.indexOf(this.bank) : (this.bank ?? -1);
    return this.bank === null || mode < 0 || mode >= this.modes.count ? null : mode;
  }

  /** Choose a mode, whose shape is painted on the object; null chooses none. The server counts inaudible modes too. */
  choose(mode) {
    this.bank = mode === null ? null : (this.live?.rows?.[mode] ?? mode);
    this.#notify("mode");
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
    [...document.getElementById("legend-ends").children].forEach((end, at) => {
      end.textContent = ends[at];
    });
  }

  /** Call `act` now and whenever one of these things happens: bundle, struck, mode, view. */
  on(names, act) {
    for (const name of names.split(" ")) this.addEventListener(name, act);
    act();
  }

  #notify(name) {
    this.dispatchEvent(new Event(name));
  }
}
