/** Small parts of a page: elements, sliders, choices, tabs, and the messages that tell what happened. */

/** An element with properties, and children that are elements or text; `on…` properties are listeners. */
export function element(tag, properties = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (name in made && !name.includes("-")) made[name] = value;
    else made.setAttribute(name, value);
  }
  made.append(...children.filter((child) => child !== null));
  return made;
}

export function button(words, onclick, properties = {}) {
  return element("button", { type: "button", onclick, ...properties }, words);
}

export const smallButton = (words, onclick) => button(words, onclick, { className: "small" });
export const section = (...children) => element("section", {}, ...children);
export const group = (...children) => element("div", { className: "group" }, ...children);
export const line = (...children) => element("div", { className: "row" }, ...children);
export const faint = (words) => element("p", { className: "faint" }, words);
export const warning = (words) => element("p", { className: "warning" }, words);

/** Names and values below each other; `facts`: [name, words] each. */
export function factList(facts) {
  const items = facts.flatMap(([name, words]) => [element("dt", {}, name), element("dd", {}, words)]);
  return element("dl", { className: "measures" }, ...items);
}

/** A slider with its name and its value in words. `even` ones step evenly, the others by factors. */
export class Slider {
  constructor(name, { low, high, value, words, even = false, steps = 200, onInput }) {
    this.toValue = even ? (share) => low + share * (high - low) : (share) => low * (high / low) ** share;
    this.toStep = (wanted) =>
      steps * (even ? (wanted - low) / (high - low) : Math.log(wanted / low) / Math.log(high / low));
    this.words = words;
    this.rest = value;
    // The label about it names its value's element, the first of the two that a label can name.
    this.input = element("input", { type: "range", min: 0, max: steps, step: 1, "aria-label": name });
    this.output = element("output");
    this.element = element("label", { className: "slider" }, element("span", {}, name), this.output, this.input);
    this.input.addEventListener("input", () => {
      // Rounding must not move a slider off its rest.
      const resting = Math.abs(this.input.value - this.toStep(this.rest)) < 0.5;
      this.#show(resting ? this.rest : this.toValue(this.input.value / steps));
      onInput?.(this.value);
    });
    this.set(value);
  }

  set(value) {
    this.input.value = Math.round(this.toStep(value));
    this.#show(value);
  }

  #show(value) {
    this.value = value;
    this.output.textContent = this.words(value);
    this.input.setAttribute("aria-valuetext", this.words(value));
  }
}

/** One of several, side by side; `options`: [value, words] each. */
export function choices(name, label, options, chosen, onChoose) {
  const inputs = options.map(([value, words]) =>
    element(
      "label",
      {},
      element("input", { type: "radio", name, checked: value === chosen, onchange: () => onChoose(value) }),
      words,
    ),
  );
  return element("div", { className: "choices", role: "radiogroup", "aria-label": label }, ...inputs);
}

/** A button that lets one choose a file. */
export function filePicker(words, accept, onFile) {
  const onchange = () => {
    const [file] = input.files;
    // The same file may be chosen again.
    input.value = "";
    if (file) onFile(file);
  };
  const input = element("input", { type: "file", accept, onchange });
  return element("label", { className: "file" }, input, words);
}

/** Words without addresses that hold a whole file: browsers say them in full where they tell what cannot be loaded. */
const withoutFiles = (words) => words.replaceAll(/:?\s*\bdata:[\w.+/-]*(?:;[\w=-]+)*,[^\s"')]*/g, "");

/** Say something over the object; `answers` are [words, action] buttons. One message of each `name` at a time. */
export function say(words, { name = words, bad = false, answers = [], seconds = 0 } = {}) {
  const close = () => message.remove();
  const actions = answers.map(([text, action]) =>
    button(text, () => {
      close();
      action();
    }),
  );
  const message = element(
    "div",
    { className: bad ? "word bad" : "word", "data-name": name },
    element("div", {}, withoutFiles(words), element("div", { className: "answers" }, ...actions)),
    button("×", close, { className: "small", "aria-label": "Close this message" }),
  );
  unsay(name);
  document.getElementById("words").append(message);
  if (seconds) setTimeout(close, 1000 * seconds);
}

export function unsay(name) {
  for (const message of document.querySelectorAll("#words .word")) if (message.dataset.name === name) message.remove();
}

/** Do something that may fail and say so; returns its result, or undefined. */
export async function attempt(action, name) {
  try {
    const result = await action();
    unsay(name);
    return result;
  } catch (error) {
    say(error.message, { name, bad: true });
    return undefined;
  }
}

/** Tabs with arrow keys, as the role promises; `sheets`: {name, words, element}. Returns what shows one by its name. */
export function makeTabs(sheets) {
  const tabs = sheets.map(({ name, words, element: sheet }) => {
    Object.assign(sheet, { id: `sheet-${name}`, className: "sheet", role: "tabpanel" });
    sheet.setAttribute("aria-labelledby", `tab-${name}`);
    return button(words, () => show(name), { id: `tab-${name}`, role: "tab", "aria-controls": `sheet-${name}` });
  });
  const show = (chosen) =>
    sheets.forEach(({ name, element: sheet }, at) => {
      tabs[at].setAttribute("aria-selected", String(name === chosen));
      tabs[at].tabIndex = name === chosen ? 0 : -1;
      sheet.hidden = name !== chosen;
    });
  tabs.forEach((tab, at) =>
    tab.addEventListener("keydown", ({ key }) => {
      const step = { ArrowRight: 1, ArrowLeft: -1 }[key];
      if (!step) return;
      const next = (at + step + tabs.length) % tabs.length;
      show(sheets[next].name);
      tabs[next].focus();
    }),
  );
  document.getElementById("tabs").append(...tabs);
  document.getElementById("sheets").append(...sheets.map(({ element: sheet }) => sheet));
  show(sheets[0].name);
  return show;
}

export const seconds = (value) => (value < 1 ? `${(1000 * value).toPrecision(3)} ms` : `${value.toPrecision(3)} s`);
export const millimeters = (position) => position.map((value) => (1000 * value).toFixed(1)).join(", ");
