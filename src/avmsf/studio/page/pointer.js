/** From a press of the pointer or a key on the object to a strike: where, and how hard. */

import { element } from "./dom.js";

const MAX_CLICK_PIXELS = 6;
/** A click this short strikes with the force that is set; a longer press strikes harder, up to `MAX_FACTOR` times. */
const CLICK_SECONDS = 0.18;
const MAX_FACTOR_SECONDS = 1.4;
const MAX_FACTOR = 10;
const TURN_RADIANS = 0.12;
const TURNS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
const LABEL =
  "The object. Click to strike it, drag to rotate it. Keys: arrows rotate, Enter strikes the center, " +
  "Shift and Enter strikes with the greatest force.";

/** How many times the force that is set a press of this length strikes. */
function forceFactor(seconds) {
  const share = (seconds - CLICK_SECONDS) / (MAX_FACTOR_SECONDS - CLICK_SECONDS);
  return MAX_FACTOR ** Math.min(Math.max(share, 0), 1);
}

/** A pen tells how hard it is pressed; a mouse or a finger does not, and strikes with the force that is set. */
function pressure(event) {
  return event.pointerType === "pen" && event.pressure > 0 ? 2 * event.pressure : 1;
}

export class StrikePointer {
  #press = null;

  /** `strike(hit, factor)` at each strike, `hover(hit)` while the pointer moves; both get what `pick` found. */
  constructor(view, { strike, hover, atPress }) {
    Object.assign(this, { view, strike, hover, atPress });
    const { canvas } = view;
    canvas.tabIndex = 0;
    canvas.setAttribute("role", "application");
    canvas.setAttribute("aria-label", LABEL);
    canvas.addEventListener("pointerdown", (event) => this.#down(event));
    canvas.addEventListener("pointermove", (event) => this.#move(event));
    canvas.addEventListener("pointerup", (event) => this.#up(event));
    canvas.addEventListener("pointercancel", () => this.#end());
    canvas.addEventListener("lostpointercapture", () => this.#end());
    canvas.addEventListener("pointerleave", () => this.hover(null));
    canvas.addEventListener("keydown", (event) => this.#key(event));
  }

  #down(event) {
    if (event.button !== 0 || !event.isPrimary) return;
    const { clientX: x, clientY: y } = event;
    if (!this.atPress()) {
      this.#press = { x, y, at: event.timeStamp, pressure: pressure(event), ring: this.#growRing(x, y) };
      return;
    }
    const hit = this.view.pick(x, y);
    if (!hit) return;
    // A press on the object plays; beside it, it turns the object. Wherever it ends, the object can be turned again.
    this.view.eye.controls.enabled = false;
    this.view.canvas.setPointerCapture(event.pointerId);
    this.strike(hit, pressure(event));
  }

  #move(event) {
    const press = this.#press;
    if (press) {
      press.pressure = Math.max(press.pressure, pressure(event));
      if (Math.hypot(event.clientX - press.x, event.clientY - press.y) > MAX_CLICK_PIXELS) this.#end();
    } else if (event.buttons === 0) {
      // Once a frame is enough: what lies under the pointer is only shown.
      this.hovering ??= requestAnimationFrame(() => {
        this.hovering = undefined;
        this.hover(this.view.pick(event.clientX, event.clientY));
      });
    }
  }

  #up(event) {
    const press = this.#press;
    this.#end();
    const hit = press && this.view.pick(press.x, press.y);
    if (hit) this.strike(hit, press.pressure * forceFactor((event.timeStamp - press.at) / 1000));
  }

  #end() {
    this.view.eye.controls.enabled = true;
    this.#press?.ring.remove();
    this.#press = null;
  }

  #growRing(x, y) {
    const box = this.view.overlay.getBoundingClientRect();
    const ring = element("div", { className: "charge" });
    Object.assign(ring.style, {
      left: `${x - box.left}px`,
      top: `${y - box.top}px`,
      animationDuration: `${MAX_FACTOR_SECONDS - CLICK_SECONDS}s`,
      animationDelay: `${CLICK_SECONDS}s`,
    });
    this.view.overlay.append(ring);
    return ring;
  }

  #key(event) {
    if (event.key in TURNS) this.view.eye.turn(...TURNS[event.key].map((step) => step * TURN_RADIANS));
    else if (event.key === "Enter" || event.key === " ") {
      // A key that is held strikes once: it repeats faster than anyone strikes.
      const box = this.view.canvas.getBoundingClientRect();
      const hit = event.repeat ? null : this.view.pick(box.left + box.width / 2, box.top + box.height / 2);
      if (hit) this.strike(hit, event.shiftKey ? MAX_FACTOR : 1);
    } else return;
    event.preventDefault();
  }
}
