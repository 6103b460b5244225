/** The tab that finds a blow: a recording in, where on the object it was struck painted and listed. */

import { amountScale } from "./colors.js";
import { attempt, button, element, factList, filePicker, group, line, millimeters, say, section, warning } from "./dom.js";
import { RecordButton } from "./recordbutton.js";
import { numbers, server } from "./server.js";
import { expectWav } from "./wav.js";

export function findSheet(studio) {
  const results = element("div", { className: "group", "aria-live": "polite" });
  const busy = element("progress", { hidden: true, "aria-label": "Locating" });
  let painted = null;
  const record = new RecordButton({ done: (blob) => locate(blob, "the recording") });

  /** Take away what was found last. */
  const forget = () => {
    results.replaceChildren();
    clearFound(studio);
    if (painted && studio.view?.painted?.values === painted) studio.paint(null);
    painted = null;
  };

  // One search at a time: while one runs, the newest recording waits and older ones are forgotten.
  let [running, wanted, newest] = [false, null, 0];
  /** Another recording is looked for, or shall be: nothing of those before it is shown or said; gives its number. */
  const begin = () => {
    forget();
    [wanted, busy.hidden] = [null, true];
    return ++newest;
  };
  const locate = (blob, name) => search({ blob, name, number: begin() });
  const search = async (recording) => {
    [wanted, busy.hidden] = [recording, false];
    if (running) return;
    running = true;
    while (wanted) {
      const asked = wanted;
      wanted = null;
      const searched = server.locate(asked.blob);
      await searched.catch(() => {});
      if (asked.number !== newest) continue;
      const answer = await attempt(() => searched, "locate");
      if (!answer) continue;
      if (answer.revision === undefined || answer.revision === studio.revision) show(answer.impacts, asked.name);
      else tellStale(answer.revision, asked);
    }
    [running, busy.hidden] = [false, true];
  };
  /** Where a blow fell on another field than the one that is shown is not where it fell on this one. */
  const tellStale = (revision, { blob, name }) => {
    const words = `The field changed while ${name} was located, so the result is not shown.`;
    const again = ["Locate again", () => locate(blob, name)];
    const load = ["Show the changed field", () => location.reload()];
    say(words, { name: "locate", bad: true, answers: [revision > studio.revision ? load : again] });
  };

  const show = (blows, name) => {
    const list = group();
    const paint = (place) => {
      painted = paintBlow(studio, blows[place]);
      list.replaceChildren(...describe(studio, blows[place]));
    };
    const several = line();
    if (blows.length > 1) {
      const pick = (_, place) => button(`Impact ${place + 1}`, () => paint(place), { className: "small" });
      several.append(...blows.map(pick));
    }
    results.replaceChildren(element("h2", {}, `${name}: ${blows.length === 1 ? "1 impact" : `${blows.length} impacts`}`));
    results.append(several, list);
    if (blows.length) paint(0);
    else results.append(element("p", {}, "No impact detected."));
  };

  const take = async (file) => {
    const number = begin();
    const fine = await attempt(() => expectWav(file).then(() => true), "locate");
    if (fine && number === newest) await search({ blob: file, name: file.name, number });
  };

  // Paint and found places belong to the recording, and to the field as it was when it was asked.
  studio.addEventListener("bundle", forget);

  const sheet = section(
    element("p", { className: "faint" }, "Strike the real object near the microphone, or drop a WAV file anywhere."),
    line(record.button, filePicker("Choose a WAV file …", ".wav,audio/wav", take)),
    record.level,
    busy,
    results,
  );
  return { element: sheet, take };
}

/** Paint where a blow may have fallen and mark where it most likely did; returns the values that are painted. */
function paintBlow(studio, blow) {
  const probability = numbers(blow.probability);
  const greatest = probability.reduce((most, value) => Math.max(most, value), 1e-30);
  // The eye tells apart what a thousandth of the greatest is only on a logarithmic scale.
  const values = probability.map((value) => 1 + Math.log10(Math.max(value / greatest, 1e-4)) / 4);
  studio.paint(values, {
    scale: amountScale,
    title: "Probability of the contact",
    ends: ["÷ 10 000", "÷ 100", "maximum"],
  });
  if (!studio.view) return values;
  clearFound(studio);
  studio.view.face(blow.position);
  const dot = () => element("div", { className: "dot next" });
  studio.view.markDot("found", dot(), blow.position, "estimate");
  (blow.equivalent_points ?? []).forEach(({ position }, number) =>
    studio.view.markDot(`found-equivalent-${number}`, dot(), position, "equivalent"),
  );
  return values;
}

function clearFound(studio) {
  studio.view?.unmarkAll("found");
}

const percent = (share) => `${(100 * share).toPrecision(2)} %`;

function describe(studio, blow) {
  const { probability: level, radius, surface_fraction: share } = blow.credible_region;
  const facts = [
    ["Contact", `${millimeters(blow.position)} mm`],
    [`${percent(level)} region`, `${(1000 * radius).toFixed(1)} mm radius, ${percent(share)} of the surface`],
  ];
  if (blow.explained_energy !== undefined && blow.explained_energy !== null)
    facts.push(["Explained energy", `${percent(blow.explained_energy)} of the sound`]);
  const parts = [factList(facts), button("Strike here", () => studio.strike(blow.row))];
  if (blow.equivalent_points?.length) {
    parts.push(element("h3", {}, "Other possible contacts"));
    const places = element("ul", { className: "listing" });
    for (const { position, probability, message } of blow.equivalent_points) {
      const text = `${millimeters(position)} mm, ${percent(probability)}${message ? `: ${message}` : ""}`;
      places.append(element("li", {}, text));
    }
    parts.push(places);
  }
  for (const note of blow.notes ?? []) parts.push(warning(note));
  return parts;
}
