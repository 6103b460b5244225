/** The tab that makes a capture: click where one is about to strike, record, look at it at once, save it or redo it. */

import { recordingUrl, server } from "./api.js";
import { ContactChoice, inward } from "./contactchoice.js";
import { attempt, button, element, filePicker, group, line, say, section, warning } from "./dom.js";
import { reconstructGroup } from "./jobs.js";
import { Outbox } from "./outbox.js";
import { RecordButton } from "./recorder.js";
import { listenButton, RecordingCard } from "./recordingcard.js";
import { UnsentRecordings } from "./unsent.js";

export async function captureTab(studio) {
  const outbox = await Outbox.open(studio.live.folder);
  const reconstruction = reconstructGroup(studio);
  /** Offer what the contact and the microphone allow. */
  const enable = () => {
    contact.lock(record.busy);
    record.button.disabled = !contact.known && !record.busy;
    attach.querySelector("input").disabled = !contact.known;
  };
  const contact = new ContactChoice(studio, () => enable());
  // The contact is locked during a recording, so it still is the one where the recording was begun.
  const record = new RecordButton({ done: (blob) => check(blob, contact.current), changed: enable, main: true });
  const attach = filePicker("Attach a WAV file …", ".wav,audio/wav", (file) => take(file));

  const card = new RecordingCard({
    keep: (entry) => {
      contact.leave(entry);
      return unsent.keep(entry);
    },
    drop: async (entry) => {
      await outbox.remove(entry.key);
      if (!contact.locked) contact.set(entry);
      record.button.focus();
    },
    refuge: () => outbox.refuge,
  });
  const list = new ImpactList(studio, {
    redo: (impact) => {
      if (contact.set({ ...impact, redo: impact.file })) record.button.focus();
    },
    changed: () => refresh(),
  });
  const unsent = new UnsentRecordings(outbox, {
    impacts: () => list.impacts,
    shown: () => card.entry,
    sent: () => refresh(),
  });

  const take = async (file) => {
    if (contact.known) await check(file, contact.current);
    else say("First click the contact of this recording on the object.", { name: "take", bad: true });
  };

  /** Show what a recording is worth before it is saved. It is stored in the browser from the first moment. */
  const check = async (blob, chosen) => {
    const entry = { key: crypto.randomUUID(), made: Date.now(), blob, ...chosen, kept: false };
    await outbox.put(entry);
    if (card.entry) say("The previous recording waits below: save or discard it.", { name: "take" });
    const shown = card.show(entry);
    unsent.show();
    await shown;
  };

  const refresh = async () => {
    const capture = await attempt(() => server.capture(), "capture");
    if (!capture) return;
    list.show(capture);
    reconstruction.setReady(capture.strikes.length, capture.ready);
    unsent.show();
  };

  enable();
  // Go on with what an earlier page left: the last recording that was not saved is shown again, the others are sent.
  const left = outbox.entries.findLast(({ kept }) => !kept);
  if (left) {
    contact.set(left);
    card.show(left);
  }
  await refresh();
  if (outbox.entries.some(({ kept }) => kept)) unsent.send();
  return {
    element: section(
      contact.element,
      group(element("h2", {}, "2. Record"), line(record.button, attach), record.level, card.element, unsent.element),
      list.element,
      reconstruction.element,
    ),
    take,
    choose: ({ place, normal }) => contact.set({ contact: place, direction: inward(normal) }),
  };
}

/** The impacts of a capture: listed, marked on the object, each to be listened to, recorded again or removed. */
class ImpactList {
  impacts = [];

  /** `redo(impact)` records one again, `changed()` is called after one was removed. */
  constructor(studio, { redo, changed }) {
    Object.assign(this, { studio, redo, changed });
    this.count = element("h2");
    this.list = element("ul", { className: "listing" });
    this.problems = group();
    this.folder = element("small");
    this.element = group(this.count, this.list, this.problems, this.folder);
    studio.addEventListener("view", () => this.#mark());
  }

  show({ folder, strikes, problems }) {
    this.impacts = strikes;
    this.count.textContent = strikes.length === 1 ? "1 impact" : `${strikes.length} impacts`;
    this.list.hidden = strikes.length === 0;
    this.list.replaceChildren(...strikes.map((impact) => this.#item(impact)));
    this.problems.replaceChildren(...problems.map((words) => warning(words)));
    this.folder.textContent = `Folder: ${folder}`;
    this.#mark();
  }

  #mark() {
    const { view } = this.studio;
    view?.unmarkAll("captured-");
    for (const { file, contact } of this.impacts.filter((impact) => impact.contact)) {
      const dot = button("", () => this.#highlight(file), { className: "dot", tabIndex: -1, title: file });
      view?.markDot(`captured-${file}`, dot, contact);
    }
  }

  #highlight(file) {
    for (const item of this.list.children) {
      item.classList.toggle("chosen", item.dataset.file === file);
      if (item.dataset.file === file) item.scrollIntoView({ block: "nearest" });
    }
  }

  #item(impact) {
    const { file, warnings, peak_db: peak } = impact;
    const level = peak === null || peak === undefined ? "" : ` ${peak.toFixed(1)} dB`;
    return element(
      "li",
      { "data-file": file },
      button(`${file}${level}`, () => this.#highlight(file), { className: "grow" }),
      listenButton(recordingUrl(file)),
      button("Redo", () => this.redo(impact), { className: "small", "aria-label": `Record ${file} again` }),
      button("×", () => this.#remove(impact), { className: "small", "aria-label": `Remove ${file}` }),
      ...warnings.map((words) => warning(words)),
    );
  }

  async #remove(impact) {
    // What is removed is gone from the table: ask first.
    if (!confirm(`Remove ${impact.file} from the capture?`)) return;
    await attempt(() => server.removeImpact(impact), "strike");
    await this.changed();
  }
}
