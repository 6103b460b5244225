/** The table of the modes: pitch, decay and level at the contact struck last; one is chosen to paint its shape. */

import { signScale } from "./colours.js";
import { button, element, seconds } from "./dom.js";

const COLUMNS = [
  ["mode", "#", "Rows of the field's bank, counted from 0"],
  ["frequency", "Pitch, Hz", "Frequency"],
  ["decay", "Decay, s", "Seconds in which the mode falls by 60 dB"],
  ["level", "Level, dB", "Below the loudest mode, at the contact struck last"],
];

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
      studio.row === null ? "Levels at the contact that is loudest." : `Levels and decays at contact ${row}.`;
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
    body.replaceChildren(
      ...rows.map(({ mode, frequency, decay, level }) => {
        const cells = [mode, frequency.toFixed(1), decay.toPrecision(3), level.toFixed(1)];
        const line = element(
          "tr",
          {
            tabIndex: 0,
            title: `Paint where the mode at ${frequency.toFixed(1)} Hz is loud`,
            "data-mode": mode,
            onclick: () => studio.choose(studio.mode === mode ? null : mode),
            onkeydown: (event) => {
              if (event.key !== "Enter" && event.key !== " ") return;
              event.preventDefault();
              studio.choose(studio.mode === mode ? null : mode);
            },
          },
          ...cells.map((words) => element("td", {}, String(words))),
        );
        line.setAttribute("aria-selected", String(mode === studio.mode));
        return line;
      }),
    );
  };

  studio.on("bundle struck", fill);
  studio.addEventListener("mode", () => {
    const { mode, modes } = studio;
    for (const line of body.children) line.setAttribute("aria-selected", String(Number(line.dataset.mode) === mode));
    // Paint of another kind, such as where a blow was found, is not this table's to take off.
    if (mode === null && painted) studio.paint(null);
    painted = mode !== null;
    if (painted) {
      const title = `Mode at ${modes.frequency(mode).toFixed(1)} Hz, ${seconds(
        modes.decayTime(mode, studio.row ?? 0),
      )}: gain`;
      const options = { scale: signScale, title, ends: ["−1", "0, a node", "+1"] };
      studio.paint(modes.shape(mode), options);
    }
  });
  // An edit moves pitches, not shapes; the paint of a mode that is gone goes with it.
  studio.addEventListener("bundle", () => {
    if (studio.bank !== null) studio.choose(studio.mode);
  });

  const tableBox = element("div", { className: "table-box" }, table);
  return {
    element: element(
      "section",
      {},
      element("p", { className: "faint" }, "Choose a mode to see where on the object it is loud."),
      tableBox,
      where,
    ),
  };
}
