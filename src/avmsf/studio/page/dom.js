/** Small parts of a page: elements, sliders, choices and the words that tell what happened. */

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

export const section = (...children) => element("section", {}, ...children);
export const group = (...children) => element("div", { className: "group" }, ...children);
export const line = (...children) => element("div", { className: "row" }, ...children);
export const warning = (words) => element("p", { className: "warning" }, words);

/** Names and values below each other; `facts`: [name, words] each. */
export function factList(facts) {
  const list = element("dl", { className: "measures" });
  for (const [name, words] of facts) list.append(element("dt", {}, name), element("dd", {}, words));
  return list;
}

/** A slider with its name and its value in words. `even` ones step evenly, the others by factors. */
export class Slider {
  constructor(name, { low, high, value, words, even = false, steps = 200, onInput }) {
    this.toValue = even
      ? (share) => low + share * (high - low)
      : (share) => low * (high / low) ** share;
    this.toShare = even
      ? (wanted) => (wanted - low) / (high - low)
      : (wanted) => Math.log(wanted / low) / Math.log(high / low);
    this.words = words;
    this.rest = value;
    this.steps = steps;
    // The label about it names its value's element, the first of the two that a label can name.
    this.input = element("input", { type: "range", min: 0, max: steps, step: 1, "aria-label": name });
    this.output = element("output");
    this.element = element("label", { className: "slider" }, element("span", {}, name), this.output, this.input);
    this.input.addEventListener("input", () => {
      // Rounding must not move a slider off its rest.
      const value = this.toValue(this.input.value / steps);
      this.#show(Math.abs(this.input.value - this.restStep) < 0.5 ? this.rest : value);
      onInput?.(this.value);
    });
    this.set(value);
  }

  get restStep() {
    return this.toShare(this.rest) * this.steps;
  }

  set(value) {
    this.input.value = Math.round(this.toShare(value) * this.steps);
    this.#show(value);
  }

  #show(value) {
    this.value = value;
    this.output.textContent = this.words(value);
    this.input.setAttribute("aria-valuetext", this.words(value));
  }

  reset() {
    this.set(this.rest);
  }
}

/** One of several, side by side; `options`: [value, words] each. */
export function choices(name, label, options, chosen, onChoose) {
  const group = element("div", { className: "choices", role: "radiogroup", "aria-label": label });
  for (const [value, words] of options) {
    const input = element("input", { type: "radio", name, checked: value === chosen, onchange: () => onChoose(value) });
    group.append(element("label", {}, input, words));
  }
  return group;
}

/** A button that lets one choose a file. */
export function filePicker(words, accept, onFile) {
  const input = element("input", {
    type: "file",
    accept,
    onchange: () => {
      const [file] = input.files;
      // The same file may be chosen again.
      input.value = "";
      if (file) onFile(file);
    },
  });
  return element("label", { className: "file" }, input, words);
}

/** Words without addresses that hold a whole file: browsers say them in full where they tell what cannot be had. */
const withoutFiles = (words) => words.replaceAll(/:?\s*\bdata:[\w.+/-]*(?:;[\w=-]+)*,[^\s"')]*/g, "");

/** Say something over the object; `answers` are [words, action] buttons. One word of each `name` at a time. */
export function say(words, { name = words, bad = false, answers = [], seconds = 0 } = {}) {
  const place = document.getElementById("words");
  const close = () => word.remove();
  const actions = answers.map(([text, action]) =>
    button(text, () => {
      close();
      action();
    }),
  );
  const word = element(
    "div",
    { className: bad ? "word bad" : "word", "data-name": name },
    element("div", {}, withoutFiles(words), answers.length ? element("div", { className: "answers" }, ...actions) : null),
    button("×", close, { className: "small", "aria-label": "Close this message" }),
  );
  unsay(name);
  place.append(word);
  if (seconds) setTimeout(close, 1000 * seconds);
  return word;
}

export function unsay(name) {
  for (const word of document.querySelectorAll("#words .word")) if (word.dataset.name === name) word.remove();
}

/** Do something that may fail and say so; returns what it gave, or undefined. */
export async function attempt(action, name) {
  try {
    const result = await action();
    if (name) unsay(name);
    return result;
  } catch (error) {
    if (error.name !== "AbortError") say(error.message, { name, bad: true });
    return undefined;
  }
}

/** Tabs with arrow keys, as the role promises; `sheets`: {name, words, element, shown?}. */
export function makeTabs(sheets) {
  const tabs = document.getElementById("tabs");
  const box = document.getElementById("sheets");
  const show = (chosen) => {
    for (const { name, element: sheet, shown } of sheets) {
      const tab = document.getElementById(`tab-${name}`);
      tab.setAttribute("aria-selected", String(name === chosen));
      tab.tabIndex = name === chosen ? 0 : -1;
      sheet.hidden = name !== chosen;
      if (name === chosen) shown?.();
    }
  };
  sheets.forEach(({ name, words, element: sheet }, place) => {
    const tab = button(words, () => show(name), { id: `tab-${name}`, role: "tab", "aria-controls": `sheet-${name}` });
    tab.addEventListener("keydown", ({ key }) => {
      const step = { ArrowRight: 1, ArrowLeft: -1 }[key];
      if (!step) return;
      const next = sheets[(place + step + sheets.length) % sheets.length];
      show(next.name);
      document.getElementById(`tab-${next.name}`).focus();
    });
    Object.assign(sheet, { id: `sheet-${name}`, className: "sheet" });
    sheet.setAttribute("role", "tabpanel");
    sheet.setAttribute("aria-labelledby", tab.id);
    tabs.append(tab);
    box.append(sheet);
  });
  show(sheets[0].name);
  return show;
}

export const seconds = (value) => (value < 1 ? `${(1000 * value).toPrecision(3)} ms` : `${value.toPrecision(3)} s`);
export const millimeters = (place) => place.map((value) => (1000 * value).toFixed(1)).join(", ");
