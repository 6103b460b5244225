/** The page: load the field, show it, sound it, and put a panel with what can be done beside it. */

import { BlowInput } from "./blowinput.js";
import { loadBundle } from "./bundle.js";
import { attempt, element, makeTabs, say } from "./dom.js";
import { editSheet } from "./edit.js";
import { findSheet } from "./find.js";
import { captureSheet } from "./capturemode.js";
import { modeTable } from "./modetable.js";
import { server } from "./server.js";
import { SoundEngine } from "./sound.js";
import { SpectrumView } from "./spectrumview.js";
import { strikeSheet } from "./strikesheet.js";
import { Studio } from "./studio.js";

const at = (name) => document.getElementById(name);
const UPS = ["z", "y", "x"];

async function open() {
  // The 3D library is by far the largest part: it is fetched beside all else, and by itself, so that the panel works
  // where it cannot be had.
  const library = import("./objectview.js");
  library.catch(() => {});
  const studio = new Studio(await loadBundle());
  window.avmsf.studio = studio;
  const capturing = studio.live?.mode === "capture";
  showTitle(studio);
  const sound = capturing ? null : startSound(studio);
  const sheets = await (capturing ? captureTabs(studio) : fieldTabs(studio));
  await showObject(studio, sheets, library);
  await sound;
  studio.dispatchEvent(new Event("view"));
  at("hint").hidden = !studio.view;
  at("hint").innerHTML = capturing
    ? "<strong>Click the object</strong> where you will strike it"
    : "<strong>Click the object</strong> to strike it. Hold longer for more force. Drag to rotate.";
  takeDrops(sheets);
  // Struck it can be from now on, and seen from the next frame.
  await new Promise((drawn) => requestAnimationFrame(drawn));
  window.avmsf.readyAt = performance.now();
  return studio;
}

function showTitle(studio) {
  studio.on("bundle", () => {
    const { name, points, sampleRate, supporting = [] } = studio.bundle.manifest;
    const poles = studio.bundle.manifest.modes;
    const modes = poles ? poles - supporting.length : 0;
    at("name").textContent = name;
    document.title = studio.live ? `${name} · avmsf studio` : name;
    const facts = [
      poles ? `${modes} modes` : null,
      points ? `${points.toLocaleString("en")} contacts` : null,
      poles ? `${Math.round(sampleRate / 100) / 10} kHz` : null,
    ];
    at("facts").textContent = facts.filter(Boolean).join(" · ");
  });
}

async function startSound(studio) {
  at("charts").hidden = false;
  studio.spectra = new SpectrumView(at("spectrum"), at("decay"));
  try {
    studio.engine = await SoundEngine.start(studio.bundle);
  } catch (error) {
    const words = `No sound: ${error.message}. The charts still show the model.`;
    say(words, { name: "sound", bad: true });
    at("output").textContent = "output (no sound)";
  }
  studio.on("bundle", () => {
    if (studio.engine && studio.engine.bundle !== studio.bundle) studio.engine.replace(studio.bundle);
    studio.spectra.listen(studio.modes, studio.engine);
  });
}

async function fieldTabs(studio) {
  const strike = strikeSheet(studio);
  studio.on("bundle", () => {
    for (const control of strike.element.querySelectorAll("button")) control.disabled = studio.modes.points === 0;
  });
  const sheets = [
    { name: "strike", words: "Strike", ...strike },
    { name: "modes", words: "Modes", ...modeTable(studio) },
  ];
  if (studio.can("locate")) sheets.push({ name: "find", words: "Locate", ...findSheet(studio) });
  if (studio.can("edit")) sheets.push({ name: "edit", words: "Edit", ...editSheet(studio, () => reload(studio)) });
  if (studio.can("capture")) sheets.push({ name: "capture", words: "Capture", ...(await captureSheet(studio)) });
  const show = makeTabs(sheets);
  const find = sheets.find(({ name }) => name === "find");
  const capture = sheets.find(({ name }) => name === "capture");
  const adding = () => capture !== undefined && !capture.element.hidden;
  return {
    atPress: () => !adding() && strike.atPress(),
    struck: (hit, factor) => {
      if (adding()) capture.choose(hit);
      else studio.strike(hit.row, { factor });
    },
    take: find && ((file) => (adding() ? capture.take(file) : (show("find"), find.take(file)))),
  };
}

async function captureTabs(studio) {
  const capture = await captureSheet(studio);
  makeTabs([{ name: "capture", words: "Capture", ...capture }]);
  if (studio.modes.points <= 1) tellOfNoObject(studio.live);
  return { atPress: () => false, struck: (hit) => capture.choose(hit), take: capture.take };
}

/** The job of the server that makes an object of pictures. */
const MAKING = "reconstruct the object from its images";

function tellOfNoObject({ job, jobKind, noObject }) {
  const name = "object";
  const words = "No object to click";
  const again = async () => (await attempt(() => server.makeObject(), name)) && location.reload();
  const answers = [["Try again", again]];
  if (job && jobKind === MAKING)
    say(`${words} yet: it is being reconstructed from the images. Until then, enter coordinates.`, { name });
  else if (noObject) say(`${words}: the reconstruction from the images failed: ${noObject}`, { name, bad: true, answers });
  else say(`${words}: enter coordinates.`, { name });
}

/** Fetch what the server now has; after an edit, say, or when another tab was faster. */
async function reload(studio) {
  const bundle = await loadBundle();
  await studio.view?.replace(bundle);
  studio.take(bundle);
}

async function showObject(studio, { atPress, struck }, library) {
  try {
    const { ObjectView } = await library;
    studio.view = await ObjectView.create(at("stage"), at("overlay"), studio.bundle);
  } catch (error) {
    say(error.message, { name: "view", bad: true });
    return;
  }
  at("stage").append(element("div", { className: "crosshair" }));
  new BlowInput(studio.view, {
    strike: (hit, factor) => {
      at("hint").hidden = true;
      struck(hit, factor);
    },
    hover: (hit) => studio.view.canvas.classList.toggle("over-object", hit !== null),
    atPress,
  });
  at("tools").hidden = false;
  at("look").addEventListener("click", () => studio.view.look(studio.view.up));
  at("upright").addEventListener("click", () => {
    const up = UPS[(UPS.indexOf(studio.view.up) + 1) % UPS.length];
    studio.view.look(up);
    at("upright").textContent = `Up: ${up}`;
  });
  const { view } = studio;
  const names = { gaussians: "Gaussians", mesh: "mesh", points: "points" };
  const label = () => {
    const { object, surface } = view.bundle.manifest;
    at("other-look").hidden = !surface;
    at("other-look").textContent = `Show ${view.source === "surface" ? names[object.kind] : "surface"}`;
  };
  studio.on("bundle", label);
  at("other-look").addEventListener("click", async () => {
    await attempt(() => view.showAs(view.source === "surface" ? "object" : "surface"), "view");
    label();
  });
  at("unpaint").addEventListener("click", () => {
    studio.choose(null);
    studio.paint(null);
  });
}

/** A WAV file may be dropped anywhere, where there is something to do with it; elsewhere it must not replace the page. */
function takeDrops({ take }) {
  const target = at("drop-target");
  const files = ({ dataTransfer }) => [...(dataTransfer?.types ?? [])].includes("Files");
  window.addEventListener("dragover", (event) => {
    if (!files(event)) return;
    event.preventDefault();
    if (take) target.hidden = false;
    else event.dataTransfer.dropEffect = "none";
  });
  window.addEventListener("dragleave", (event) => {
    if (event.relatedTarget === null) target.hidden = true;
  });
  window.addEventListener("drop", (event) => {
    event.preventDefault();
    target.hidden = true;
    const [file] = event.dataTransfer?.files ?? [];
    if (!file) return;
    if (take) take(file);
    else say("This page has no server to locate impacts: open the field with avmsf studio.");
  });
}

/** For scripts and tests: the same doors as the pointer's. */
window.avmsf = {
  ready: null,
  /** Strike a contact, by its row or by a place on the object, meters. */
  strike(contact, { force = 1, contactTime = null } = {}) {
    const { studio } = window.avmsf;
    const row = typeof contact === "number" ? contact : studio.view.contactAt(contact).row;
    studio.strike(row, { force, contactTime });
    return row;
  },
  /** The sound of blows [{row, force, contactTime, when}], from the bank that plays. */
  renderOffline: (blows, seconds, options) => window.avmsf.studio.engine.renderOffline(blows, seconds, options),
  pick: (clientX, clientY) => window.avmsf.studio.view.pick(clientX, clientY),
  project: (place) => window.avmsf.studio.view.project(place),
  /** Values and colors that the contacts are painted by; null without paint. */
  painted: () => window.avmsf.studio.view.painted,
};

window.avmsf.ready = open().catch((error) => {
  at("name").textContent = "Nothing to show";
  say(error.message, { name: "open", bad: true, answers: [["Reload", () => location.reload()]] });
  throw error;
});
