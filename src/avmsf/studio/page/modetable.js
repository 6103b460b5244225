/** The table of the modes: pitch, decay and level at the last contact; one is chosen to paint its shape. */

import { signScale } from "./colors.js";
import { button, element, faint, seconds, section, smallButton } from "./dom.js";

const COLUMNS = [
  ["mode", "#", "Number of the mode in the field, from 1"],
  ["frequency", "Frequency, Hz", "Damped frequency"],
  ["decay", "Decay, s", "Time in which the mode decays by 60 dB"],
  ["level", "Level, dB", "Relative to the loudest mode, at the last contact"],
];

export function modesTab(studio) {
  let order = { column: "frequency", down: false };
  let painted = false;
  const body = element("tbody");
  const where = element("small");
  const heads = COLUMNS.map(([name, words, title]) => {
    const sort = button(words, () => {
      order = { column: name, down: order.column === name ? !order.down : name === "level" };
      fill();
    });
    return element("th", { scope: "col", title, "data-column": name }, sort);
  });
  const table = element("table", { "aria-label": "Modes" }, element("thead", {}, element("tr", {}, ...heads)), body);

  const fill = () => {
    const { modes } = studio;
    const contact = studio.row ?? modes.loudestRow;
    where.textContent =
      (studio.row === null ? "Levels at the loudest contact." : `Levels and decays at contact ${contact}.`) +
      (modes.supporting.size ? " In italics: supporting poles, which are not modes of the object." : "");
    const rows = modes.levels(contact).map((level, mode) => ({
      mode,
      frequency: modes.frequency(mode),
      decay: modes.decayTime(mode, contact),
      level,
    }));
    rows.sort((one, other) => (order.down ? -1 : 1) * (one[order.column] - other[order.column]));
    for (const head of heads) {
      const sorted = head.dataset.column === order.column;
      head.setAttribute("aria-sort", sorted ? (order.down ? "descending" : "ascending") : "none");
    }
    const focused = document.activeElement?.closest("tr[data-mode]")?.dataset.mode;
    body.replaceChildren(...rows.map(rowOf));
    body.querySelector(`[data-mode="${focused}"] button`)?.focus();
  };
  const rowOf = ({ mode, frequency, decay, level }) => {
    // The button is for keys and for who does not see; a click anywhere in its row presses it.
    const choose = smallButton(String((studio.live?.rows?.[mode] ?? mode) + 1), () => {});
    choose.ariaPressed = String(mode === studio.mode);
    choose.title = `Color the object by the gain of the mode at ${frequency.toFixed(1)} Hz`;
    choose.ariaLabel = choose.title;
    const numbers = [frequency.toFixed(1), decay.toPrecision(3), level.toFixed(1)];
    const properties = {
      "data-mode": mode,
      className: studio.modes.supporting.has(mode) ? "supporting" : "",
      onclick: () => studio.choose(studio.mode === mode ? null : mode),
    };
    const cells = [choose, ...numbers].map((cell) => element("td", {}, cell === "NaN" ? "–" : cell));
    return element("tr", properties, ...cells);
  };

  studio.on("bundle struck", fill);
  studio.addEventListener("mode", () => {
    const { mode, modes } = studio;
    for (const row of body.children)
      row.querySelector("button").ariaPressed = String(Number(row.dataset.mode) === mode);
    // Paint of another kind, such as the position of an impact, is not this table's to take off.
    if (mode === null && painted) studio.paint(null);
    painted = mode !== null;
    if (!painted) return;
    const decay = seconds(modes.decayTime(mode, studio.row ?? 0));
    const title = `Mode at ${modes.frequency(mode).toFixed(1)} Hz, ${decay}: gain`;
    studio.paint(modes.shape(mode), { scale: signScale, title, ends: ["−1", "0", "+1"] });
  });
  // An edit moves pitches, not shapes; the paint of a mode that is gone goes with it.
  studio.addEventListener("bundle", () => {
    if (studio.bank !== null) studio.choose(studio.mode);
  });

  return {
    element: section(
      faint("Choose a mode to color the object by its gain."),
      element("div", { className: "table-box" }, table),
      where,
    ),
  };
}
