/** From a press to a blow: where, how hard, and with how hard a mallet. */

const MOVED = 6;
/** A click this short strikes with the force that is set; a longer press strikes harder, up to `HARDEST` times. */
const CLICK_SECONDS = 0.18;
const HARDEST_SECONDS = 1.4;
const HARDEST = 10;

/** How many times the force that is set a press of this length strikes. */
export function hardness(seconds) {
  const share = Math.min(Math.max((seconds - CLICK_SECONDS) / (HARDEST_SECONDS - CLICK_SECONDS), 0), 1);
  return HARDEST ** share;
}

export class BlowInput {
  #press = null;

  /** `strike(hit, factor, event)` at each blow, `hover(hit)` while the pointer moves; both get what `pick` found. */
  constructor(view, { strike, hover, atPress }) {
    this.view = view;
    this.strike = strike;
    this.hover = hover;
    this.atPress = atPress;
    const { canvas } = view;
    canvas.tabIndex = 0;
    canvas.setAttribute("role", "application");
    canvas.setAttribute(
      "aria-label",
      "The object. Click to strike it, drag to rotate it. Keys: arrows rotate, Enter strikes the center, " +
        "Shift and Enter strikes with the greatest force.",
    );
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
    if (this.atPress()) {
      const hit = this.view.pick(x, y);
      if (hit) {
        // A press on the object plays; beside it, it turns the object. Wherever it ends, the object can be turned again.
        this.view.controls.enabled = false;
        this.view.canvas.setPointerCapture(event.pointerId);
        this.strike(hit, pressure(event), event);
      }
      return;
    }
    this.#press = { x, y, at: event.timeStamp, pressure: pressure(event) };
    this.#press.ring = this.#growRing(x, y);
  }

  #move(event) {
    const press = this.#press;
    if (!press) {
      if (event.buttons === 0) this.#hoverSoon(event);
      return;
    }
    press.pressure = Math.max(press.pressure, pressure(event));
    if (Math.hypot(event.clientX - press.x, event.clientY - press.y) > MOVED) this.#end();
  }

  #hoverSoon({ clientX, clientY }) {
    // Once a frame is enough: what lies under the pointer is only shown.
    this.hovering ??= requestAnimationFrame(() => {
      this.hovering = undefined;
      this.hover(this.view.pick(clientX, clientY));
    });
  }

  #up(event) {
    const press = this.#press;
    this.#end();
    if (!press) return;
    const hit = this.view.pick(press.x, press.y);
    if (hit) this.strike(hit, press.pressure * hardness((event.timeStamp - press.at) / 1000), event);
  }

  #end() {
    this.view.controls.enabled = true;
    this.#press?.ring.remove();
    this.#press = null;
  }

  #growRing(x, y) {
    const box = this.view.overlay.getBoundingClientRect();
    const ring = document.createElement("div");
    ring.className = "charge";
    ring.style.left = `${x - box.left}px`;
    ring.style.top = `${y - box.top}px`;
    ring.style.animationDuration = `${HARDEST_SECONDS - CLICK_SECONDS}s`;
    ring.style.animationDelay = `${CLICK_SECONDS}s`;
    this.view.overlay.append(ring);
    return ring;
  }

  #key(event) {
    const turns = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    if (event.key in turns) this.view.turn(...turns[event.key].map((step) => step * 0.12));
    else if (event.key === "Enter" || event.key === " ") {
      // A key that is held strikes once: it repeats faster than anyone strikes.
      const box = this.view.canvas.getBoundingClientRect();
      const hit = event.repeat ? null : this.view.pick(box.left + box.width / 2, box.top + box.height / 2);
      if (hit) this.strike(hit, event.shiftKey ? HARDEST : 1, event);
    } else return;
    event.preventDefault();
  }
}

/** A pen tells how hard it is pressed; a mouse or a finger does not, and strikes with the force that is set. */
function pressure(event) {
  return event.pointerType === "pen" && event.pressure > 0 ? 2 * event.pressure : 1;
}
