/** The tab that locates impacts: from a recording to the contacts where they fell, painted and listed. */

import { numbers, server } from "./api.js";
import { amountScale } from "./colors.js";
import { attempt, button, element, factList, faint, filePicker, group, line } from "./dom.js";
import { millimeters, say, section, smallButton, warning } from "./dom.js";
import { RecordButton } from "./recorder.js";

export function locateTab(studio) {
  const results = element("div", { className: "group", "aria-live": "polite" });
  const busy = element("progress", { hidden: true, "aria-label": "Locating" });
  const record = new RecordButton({ done: (blob) => locate(blob, "the recording") });
  let painted = null;
  // One search at a time: while one runs, the newest recording waits and older ones are forgotten.
  let [running, waiting] = [false, null];

  /** Take away the last result. */
  const clear = () => {
    results.replaceChildren();
    studio.view?.unmarkAll("located");
    if (painted && studio.view?.painted?.values === painted) studio.paint(null);
    painted = null;
  };
  const locate = async (blob, name) => {
    clear();
    [waiting, busy.hidden] = [{ blob, name }, false];
    if (running) return;
    running = true;
    while (waiting) {
      const asked = waiting;
      waiting = null;
      const answered = server.locate(asked.blob);
      await answered.catch(() => {});
      if (waiting) continue;
      const answer = await attempt(() => answered, "locate");
      if (!answer) continue;
      if (answer.revision === undefined || answer.revision === studio.revision) show(answer.impacts, asked.name);
      else sayStale(answer.revision, asked);
    }
    [running, busy.hidden] = [false, true];
  };
  /** Where an impact fell on another field than the one that is shown is not where it fell on this one. */
  const sayStale = (revision, { blob, name }) => {
    const words = `The field changed while ${name} was located, so the result is not shown.`;
    const load = ["Show the changed field", () => location.reload()];
    const again = ["Locate again", () => locate(blob, name)];
    say(words, { name: "locate", bad: true, answers: [revision > studio.revision ? load : again] });
  };

  const show = (impacts, name) => {
    const details = group();
    const choose = (impact) => {
      painted = paintImpact(studio, impact);
      details.replaceChildren(...describe(studio, impact));
    };
    const picks = impacts.map((impact, index) => smallButton(`Impact ${index + 1}`, () => choose(impact)));
    results.replaceChildren(
      element("h2", {}, `${name}: ${impacts.length === 1 ? "1 impact" : `${impacts.length} impacts`}`),
      line(...(picks.length > 1 ? picks : [])),
      impacts.length ? details : element("p", {}, "No impact detected."),
    );
    if (impacts.length) choose(impacts[0]);
  };

  const take = (file) => locate(file, file.name);

  // What is painted belongs to the recording, and to the field as it was when it was located.
  studio.addEventListener("bundle", clear);

  const sheet = section(
    faint("Strike the real object near the microphone, or drop a WAV file anywhere."),
    line(record.button, filePicker("Choose a WAV file …", ".wav,audio/wav", take)),
    record.level,
    busy,
    results,
  );
  return { element: sheet, take };
}

/** Paint the probability of an impact's contact and mark the most probable one; returns the values that are painted. */
function paintImpact(studio, { probability, position, equivalent_points: equivalents }) {
  const shares = numbers(probability);
  const greatest = shares.reduce((most, value) => Math.max(most, value), 1e-30);
  // A thousandth of the greatest can be told from nothing on a logarithmic scale only.
  const values = shares.map((value) => 1 + Math.log10(Math.max(value / greatest, 1e-4)) / 4);
  const title = "Probability of the contact";
  studio.paint(values, { scale: amountScale, title, ends: ["÷ 10 000", "÷ 100", "maximum"] });
  const { view } = studio;
  if (!view) return values;
  view.unmarkAll("located");
  view.eye.face(position);
  const dot = () => element("div", { className: "dot next" });
  view.markDot("located", dot(), position, "estimate");
  (equivalents ?? []).forEach((other, index) => view.markDot(`located-${index}`, dot(), other.position, "equivalent"));
  return values;
}

const percent = (share) => `${(100 * share).toPrecision(2)} %`;

function describe(studio, impact) {
  const { probability: level, radius, surface_fraction: share } = impact.credible_region;
  const facts = [
    ["Contact", `${millimeters(impact.position)} mm`],
    [`${percent(level)} region`, `${(1000 * radius).toFixed(1)} mm radius, ${percent(share)} of the surface`],
  ];
  if (Number.isFinite(impact.explained_energy))
    facts.push(["Explained energy", `${percent(impact.explained_energy)} of the sound`]);
  const parts = [factList(facts), button("Strike here", () => studio.strike(impact.row))];
  if (impact.equivalent_points?.length) {
    const items = impact.equivalent_points.map(({ position, probability }) =>
      element("li", {}, `${millimeters(position)} mm, ${percent(probability)}`),
    );
    parts.push(element("h3", {}, "Other possible contacts"), element("ul", { className: "listing" }, ...items));
  }
  return [...parts, ...(impact.notes ?? []).map(warning)];
}
