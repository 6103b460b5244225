/** The tab with which one plays: force, mallet, and the blows that were measured. */

import { button, choices, element, group, line, seconds, section, Slider } from "./dom.js";
import { measuredStrikes } from "./strikes.js";

const MALLETS = [
  [null, "As recorded"],
  [0.0002, "Steel"],
  [0.001, "Wood"],
  [0.004, "Rubber"],
  [0.012, "Felt"],
];

export function strikeSheet(studio) {
  const unit = studio.forceUnit;
  const counted = studio.bundle.manifest.perNewton ? "" : ", × a recorded impact";
  const force = new Slider(`Force of a click${counted}`, {
    low: 0.05,
    high: 20,
    value: 1,
    words: (value) => `${value.toPrecision(2)}${unit}`,
    onInput: (value) => {
      studio.force = value;
    },
  });
  const contact = new Slider("Contact time", {
    low: 0.00005,
    high: 0.03,
    value: 0.001,
    words: seconds,
    onInput: (value) => {
      studio.contactTime = value;
      for (const input of mallet.querySelectorAll("input")) input.checked = false;
    },
  });
  const mallet = choices("mallet", "Mallet", MALLETS, null, (time) => {
    studio.contactTime = time;
    pulse.hidden = time === null;
    if (time !== null) contact.set(time);
    if (studio.row !== null) studio.strike(studio.row);
  });
  const shape = element(
    "select",
    { "aria-label": "Shape of the force over the contact time", onchange: () => (studio.pulse = shape.value) },
    element("option", { value: "half-sine" }, "force: half-sine"),
    element("option", { value: "hertz" }, "force: Hertzian contact"),
  );
  const pulse = element("div", { className: "group", hidden: true }, contact.element, shape);
  const volume = new Slider("Volume", {
    low: 0.05,
    high: 4,
    value: 1,
    words: (value) => `${Math.round(100 * value)} %`,
    onInput: (value) => studio.engine?.setVolume(value),
  });
  const atPress = element("input", { type: "checkbox" });
  const sheet = section(
    group(
      force.element,
      element("small", {}, "Hold a click longer to strike up to ten times harder; a pen's pressure counts too."),
    ),
    group(element("h2", {}, "Mallet"), mallet, pulse),
    element(
      "label",
      { className: "check" },
      atPress,
      "Sound at the press, without waiting for the release",
    ),
    line(
      button("Strike again", () => studio.strikeAgain()),
      button("Strike at random", () => studio.strike(Math.floor(Math.random() * studio.modes.points))),
    ),
    measuredStrikes(studio),
    volume.element,
  );
  return { element: sheet, atPress: () => atPress.checked };
}
