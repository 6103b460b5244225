/** The table of the modes: pitch, decay and level at the contact struck last; one is chosen to paint its shape. */

import { signScale } from "./colors.js";
import { button, element, seconds, section } from "./dom.js";

const COLUMNS = [
  ["mode", "#", "Index of the mode in the field, from 0"],
  ["frequency", "Frequency, Hz", "Damped frequency"],
  ["decay", "Decay, s", "Time in which the mode decays by 60 dB"],
  ["level", "Level, dB", "Relative to the loudest mode, at the last contact"],
];

const lineOf = (part) => part.closest("tr");

export function modeTable(studio) {
  let order = { column: "frequency", down: false };
  const body = element("tbody");
  const head = element("tr");
  for (const [name, words, title] of COLUMNS) {
    const sort = button(words, () => {
      order = { column: name, down: order.column === name ? !order.down : name === "level" };
      fill();
    });
    head.append(element("th", { scope: "col", title, "data-column": name }, sort));
  }
  const table = element("table", { "aria-label": "Modes" }, element("thead", {}, head), body);
  const where = element("small");
  let painted = false;

  const fill = () => {
    const { modes } = studio;
    const row = studio.row ?? modes.loudestRow;
    const levels = modes.levels(row);
    where.textContent =
      (studio.row === null ? "Levels at the loudest contact." : `Levels and decays at contact ${row}.`) +
      (modes.supporting.size ? " In italics: supporting poles, which are not modes of the object." : "");
    const rows = levels.map((level, mode) => ({
      mode,
      frequency: modes.frequency(mode),
      decay: modes.decayTime(mode, row),
      level,
    }));
    rows.sort((one, other) => (order.down ? -1 : 1) * (one[order.column] - other[order.column]));
    for (const cell of head.children) {
      if (cell.dataset.column === order.column) cell.setAttribute("aria-sort", order.down ? "descending" : "ascending");
      else cell.removeAttribute("aria-sort");
    }
    const focused = body.contains(document.activeElement) ? lineOf(document.activeElement).dataset.mode : null;
    body.replaceChildren(
      ...rows.map(({ mode, frequency, decay, level }) => {
        const title = `Color the object by the gain of the mode at ${frequency.toFixed(1)} Hz`;
        const pressed = String(mode === studio.mode);
        const numbers = [frequency.toFixed(1), decay.toPrecision(3), level.toFixed(1)];
        // The button is for keys and for who does not see; a click anywhere in its line presses it.
        const choose = button(String(mode + 1), () => {}, { className: "small", title, "aria-pressed": pressed });
        choose.setAttribute("aria-label", title);
        return element(
          "tr",
          {
            "data-mode": mode,
            className: modes.supporting.has(mode) ? "supporting" : "",
            onclick: () => studio.choose(studio.mode === mode ? null : mode),
          },
          element("td", {}, choose),
          ...numbers.map((words) => element("td", {}, words === "NaN" ? "–" : words)),
        );
      }),
    );
    if (focused !== null) body.querySelector(`[data-mode="${focused}"] button`)?.focus();
  };

  studio.on("bundle struck", fill);
  studio.addEventListener("mode", () => {
    const { mode, modes } = studio;
    for (const press of body.querySelectorAll("button"))
      press.setAttribute("aria-pressed", String(Number(lineOf(press).dataset.mode) === mode));
    // Paint of another kind, such as where a blow was found, is not this table's to take off.
    if (mode === null && painted) studio.paint(null);
    painted = mode !== null;
    if (painted) {
      const title = `Mode at ${modes.frequency(mode).toFixed(1)} Hz, ${seconds(
        modes.decayTime(mode, studio.row ?? 0),
      )}: gain`;
      const options = { scale: signScale, title, ends: ["−1", "0", "+1"] };
      studio.paint(modes.shape(mode), options);
    }
  });
  // An edit moves pitches, not shapes; the paint of a mode that is gone goes with it.
  studio.addEventListener("bundle", () => {
    if (studio.bank !== null) studio.choose(studio.mode);
  });

  const tableBox = element("div", { className: "table-box" }, table);
  return {
    element: section(
      element("p", { className: "faint" }, "Choose a mode to color the object by its gain."),
      tableBox,
      where,
    ),
  };
}
