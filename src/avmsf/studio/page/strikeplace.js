/** Where the next recording is struck: a contact that is clicked or typed, or a strike that is recorded again. */

import { button, element, group, line, millimeters, say } from "./dom.js";

const NOWHERE = Object.freeze({ contact: null, direction: null, redo: null, digest: null });

/** A blow goes into the surface. */
export const inward = (normal) => normal?.map((value) => -value) ?? null;

export const placeInWords = ({ contact, redo }) => (redo ? `of ${redo}` : `at ${millimeters(contact)} mm`);

export class StrikePlace {
  /** {contact, direction, redo, digest}: what is recorded belongs here; never changed, only another put in its place. */
  now = NOWHERE;
  locked = false;

  /** `changed()` is called when another place was chosen. */
  constructor(studio, changed) {
    Object.assign(this, { studio, changed });
    this.words = element("p", { className: "faint" });
    this.inputs = ["x", "y", "z"].map(() =>
      element("input", { type: "number", step: "any", oninput: () => this.#typed() }),
    );
    const labels = ["x", "y", "z"].map((axis, at) => element("label", {}, `${axis}, mm`, this.inputs[at]));
    this.stopRedo = button("Cancel", () => this.set(NOWHERE));
    this.element = group(
      element("h2", {}, "1. Contact"),
      this.words,
      element("div", { className: "place" }, ...labels),
      line(this.stopRedo),
    );
    studio.addEventListener("view", () => this.#mark());
    this.#show();
  }

  get known() {
    return this.now !== NOWHERE;
  }

  /** Choose where; gives whether that was possible, which it is not while a blow is recorded there. */
  set(place) {
    if (this.locked) {
      say("The contact cannot change during a recording.", { name: "place", seconds: 4 });
      return false;
    }
    this.now = place === NOWHERE ? NOWHERE : Object.freeze({ ...NOWHERE, ...place });
    this.inputs.forEach((input, axis) => {
      input.value = this.now.contact ? (1000 * this.now.contact[axis]).toFixed(2) : "";
    });
    this.#mark();
    this.#show();
    this.changed();
    return true;
  }

  /** Done with a place, unless another has been chosen meanwhile. */
  leave(place) {
    if (!this.locked && this.now === place) this.set(NOWHERE);
  }

  lock(locked) {
    this.locked = locked;
    this.#show();
  }

  #typed() {
    const values = this.inputs.map((input) => input.valueAsNumber);
    if (!values.every(Number.isFinite)) return;
    const contact = values.map((value) => value / 1000);
    const direction = this.studio.view ? inward(this.studio.view.contactAt(contact).normal) : null;
    this.now = Object.freeze({ ...NOWHERE, contact, direction });
    this.#mark();
    this.#show();
    this.changed();
  }

  #mark() {
    const { view } = this.studio;
    const { contact, direction } = this.now;
    if (!view) return;
    if (!contact) {
      view.unmark("next");
      return;
    }
    const dot = element("div", { className: "dot next" });
    const mark = element("div", { className: "mark" }, dot, element("span", { className: "label" }, "strike here"));
    view.mark("next", mark, contact, inward(direction));
  }

  #show() {
    const { redo } = this.now;
    this.words.textContent = redo
      ? `Strike the contact of ${redo} again.`
      : this.known
        ? "Record the impact, or attach its recording."
        : "Click the object where you will strike it.";
    // A strike that is recorded again stays where it is.
    for (const input of this.inputs) input.disabled = this.locked || redo !== null;
    this.stopRedo.hidden = redo === null || this.locked;
  }
}
