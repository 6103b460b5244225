/** One recording before it is kept: what it looks like, how loud it is, when it begins, whether it is cut off. */

import { attempt, button, element, factList, group, seconds, warning } from "./dom.js";

/** What the server measured, in words; `report` as `capture/check` gives it. */
export function measures(report) {
  const rows = [
    ["Peak", report.peak_db === null ? "silence" : `${report.peak_db.toFixed(1)} dB re full scale`],
    ["Clipping", report.clipped ? "yes: the loudest samples are cut off" : "none"],
    ["Onset", report.onset_seconds === null ? "no impact found" : `at ${seconds(report.onset_seconds)}`],
    ["Length", seconds(report.seconds)],
  ];
  const warnings = report.warnings ?? [];
  const verdict = warnings.length
    ? warnings.map((words) => warning(words))
    : [element("p", { className: "fine" }, "✓ No problems found.")];
  return group(factList(rows), ...verdict);
}

/** Draw a recording's envelope into a canvas, and a line at its onset. */
export async function drawTake(canvas, blob, onset) {
  const { samples, sampleRate } = await decode(blob);
  const context = canvas.getContext("2d");
  const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((size) => Math.round(size * devicePixelRatio));
  [canvas.width, canvas.height] = [width, height];
  const style = getComputedStyle(canvas);
  context.fillStyle = style.getPropertyValue("--second");
  const peak = samples.reduce((most, value) => Math.max(most, Math.abs(value)), 1e-9);
  for (let x = 0; x < width; x++) {
    let [low, high] = [0, 0];
    const last = ((x + 1) * samples.length) / width;
    for (let at = Math.floor((x * samples.length) / width); at < last; at++) {
      low = Math.min(low, samples[at]);
      high = Math.max(high, samples[at]);
    }
    const y = (value) => (height / 2) * (1 - (0.95 * value) / peak);
    context.fillRect(x, y(high), 1, Math.max(1, y(low) - y(high)));
  }
  if (onset === null || onset === undefined) return;
  context.fillStyle = style.getPropertyValue("--first");
  context.fillRect((onset * sampleRate * width) / samples.length, 0, 2 * devicePixelRatio, height);
}

async function decode(blob) {
  const bytes = await blob.arrayBuffer();
  const buffer = await new OfflineAudioContext(1, 1, 48000).decodeAudioData(bytes);
  return { samples: buffer.getChannelData(0), sampleRate: buffer.sampleRate };
}

let playing = null;

/** A button that plays a recording, a blob or an address, by the browser's own player; one recording at a time. */
export function listenButton(sound) {
  return button("Listen", () => attempt(() => listen(sound), "listen"), { className: "small" });
}

async function listen(sound) {
  playing?.end();
  const address = sound instanceof Blob ? URL.createObjectURL(sound) : sound;
  const player = new Audio(address);
  const mine = {
    end() {
      player.pause();
      if (address !== sound) URL.revokeObjectURL(address);
      if (playing === mine) playing = null;
    },
  };
  playing = mine;
  player.addEventListener("ended", mine.end);
  try {
    await player.play();
  } catch (error) {
    // Another was begun before this one was read.
    if (playing !== mine) return;
    mine.end();
    throw new Error(`The recording cannot be played (${error.message}).`);
  }
}
