/** Where the next impact is recorded: a contact that is clicked or typed, or an impact that is recorded again. */

import { button, element, faint, group, line, millimeters, say } from "./dom.js";

const NOWHERE = Object.freeze({ contact: null, direction: null, redo: null, digest: null });

/** A strike goes into the surface. */
export const inward = (normal) => normal?.map((value) => -value) ?? null;

export const describeContact = ({ contact, redo }) => (redo ? `of ${redo}` : `at ${millimeters(contact)} mm`);

export class ContactChoice {
  /** {contact, direction, redo, digest}: what is recorded belongs here; replaced, and never changed. */
  current = NOWHERE;
  locked = false;

  /** `changed()` is called when another contact was chosen. */
  constructor(studio, changed) {
    Object.assign(this, { studio, changed });
    this.words = faint("");
    this.inputs = ["x", "y", "z"].map(() =>
      element("input", { type: "number", step: "any", oninput: () => this.#typed() }),
    );
    const labels = ["x", "y", "z"].map((axis, at) => element("label", {}, `${axis}, mm`, this.inputs[at]));
    this.cancel = button("Cancel", () => this.set(NOWHERE));
    this.element = group(
      element("h2", {}, "1. Contact"),
      this.words,
      element("div", { className: "place" }, ...labels),
      line(this.cancel),
    );
    studio.on("view", () => this.#show());
  }

  get known() {
    return this.current !== NOWHERE;
  }

  /** Choose where, of an entry or an impact; gives whether that was possible, which it is not during a recording. */
  set({ contact, direction, redo = null, digest = null }) {
    if (this.locked) {
      say("The contact cannot change during a recording.", { name: "place", seconds: 4 });
      return false;
    }
    this.current = contact || redo ? Object.freeze({ contact, direction, redo, digest }) : NOWHERE;
    this.inputs.forEach((input, axis) => {
      input.value = contact ? (1000 * contact[axis]).toFixed(2) : "";
    });
    this.#show();
    this.changed();
    return true;
  }

  /** Done with the contact of a recording, unless another has been chosen meanwhile. */
  leave({ contact, redo }) {
    if (!this.locked && this.current.contact === contact && this.current.redo === redo) this.set(NOWHERE);
  }

  lock(locked) {
    this.locked = locked;
    this.#show();
  }

  #typed() {
    const values = this.inputs.map((input) => input.valueAsNumber);
    if (!values.every(Number.isFinite)) return;
    const contact = values.map((value) => value / 1000);
    const { view, contacts } = this.studio;
    const direction = view ? inward(contacts.normal(contacts.nearest(contact).row)) : null;
    this.current = Object.freeze({ ...NOWHERE, contact, direction });
    this.#show();
    this.changed();
  }

  #show() {
    const { contact, direction, redo } = this.current;
    const { view } = this.studio;
    view?.unmark("next");
    const dot = element("div", { className: "dot next" });
    if (contact) view?.markDot("next", dot, contact, "strike here", inward(direction));
    this.words.textContent = redo
      ? `Strike the contact of ${redo} again.`
      : this.known
        ? "Record the impact, or attach its recording."
        : "Click the object where you will strike it.";
    // An impact that is recorded again stays where it is.
    for (const input of this.inputs) input.disabled = this.locked || redo !== null;
    this.cancel.hidden = redo === null || this.locked;
  }
}
