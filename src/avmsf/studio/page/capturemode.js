/** The tab that makes a capture: click where one is about to strike, record, look at it at once, keep it or redo it. */

import { attempt, element, filePicker, group, line, say, section, unsay } from "./dom.js";
import { CapturedStrikes } from "./capturedstrikes.js";
import { newKey, Outbox } from "./outbox.js";
import { reconstructGroup } from "./reconstruct.js";
import { RecordButton } from "./recordbutton.js";
import { server } from "./server.js";
import { inward, StrikePlace } from "./strikeplace.js";
import { TakeCard } from "./takecard.js";
import { Waiting } from "./waiting.js";
import { expectWav } from "./wav.js";

export async function captureSheet(studio) {
  const outbox = await Outbox.open();
  const reconstruction = reconstructGroup(studio);
  /** The place for which the recording was made that is judged now. */
  let struckPlace = null;

  /** Offer what the place and the microphone allow. */
  const allow = () => {
    place.lock(record.busy);
    record.button.disabled = !place.known && !record.busy;
    attach.querySelector("input").disabled = !place.known;
  };
  const place = new StrikePlace(studio, allow);
  // The place is locked while a blow is recorded, so it still is the one where the recording was begun.
  const record = new RecordButton({ done: (blob) => judge(blob, place.now), changed: allow, main: true });
  const attach = filePicker("Attach a WAV file …", ".wav,audio/wav", (file) => take(file));

  const card = new TakeCard({
    keep: (made) => {
      place.leave(struckPlace);
      return waiting.keep(made);
    },
    drop: async (made) => {
      await outbox.remove(made.key);
      if (!place.locked && place.now !== struckPlace) place.set(placeOf(made));
      record.button.focus();
    },
    refuge: () => outbox.refuge,
  });
  const captured = new CapturedStrikes(studio, {
    redo: ({ file, contact, direction, digest }) => {
      if (place.set({ contact, direction, redo: file, digest })) record.button.focus();
    },
    changed: () => refresh(),
  });
  const waiting = new Waiting(outbox, {
    strikes: () => captured.strikes,
    shown: () => card.take,
    sent: () => refresh(),
  });

  const take = async (file) => {
    const struck = place.now;
    if (!place.known) {
      say("First click the contact of this recording on the object.", { name: "take", bad: true });
      return;
    }
    const fine = await attempt(() => expectWav(file).then(() => true), "take");
    if (fine) await judge(file, struck);
  };

  /** Show what a recording is worth before it is kept. It is kept in the browser from the first moment. */
  const judge = async (blob, struck) => {
    const made = { key: newKey(), made: Date.now(), blob, ...struck, kept: false };
    await outbox.put(made);
    if (card.take) say("The previous recording waits below: save or discard it.", { name: "take" });
    struckPlace = struck;
    const judged = card.show(made);
    waiting.show();
    await judged;
  };

  const read = async () => {
    const capture = await server.capture();
    captured.show(capture);
    reconstruction.setReady(capture.strikes.length, capture.ready);
    takeUp(await outbox.belongTo(capture.folder));
    waiting.show();
  };
  const refresh = async () => {
    try {
      await read();
      unsay("capture");
    } catch (error) {
      // Of a server that does not answer the recordings that wait for it tell.
      if (!error.unreachable) say(error.message, { name: "capture", bad: true });
    }
  };
  /** Go on with what an earlier page left: the last recording that was not kept is shown again, the kept are sent. */
  const takeUp = (left) => {
    const last = left.findLast(({ kept }) => !kept);
    if (last && !card.take && !place.known) {
      place.set(placeOf(last));
      struckPlace = place.now;
      card.show(last);
    }
    if (left.some(({ kept }) => kept)) waiting.send();
  };

  allow();
  await attempt(read, "capture");
  return {
    element: section(
      place.element,
      group(element("h2", {}, "2. Record"), line(record.button, attach), record.level, card.element, waiting.element),
      captured.element,
      reconstruction.element,
    ),
    take,
    choose: ({ place: contact, normal }) => place.set({ contact, direction: inward(normal) }),
  };
}

const placeOf = ({ contact, direction, redo, digest }) => ({ contact, direction, redo, digest });
