/** The page: load the field, show it, sound it, and put a panel with what can be done beside it. */

import { loadBundle, server } from "./api.js";
import { captureTab } from "./capture.js";
import { SpectrumView } from "./charts.js";
import { attempt, element, makeTabs, say } from "./dom.js";
import { editTab } from "./edit.js";
import { locateTab } from "./locate.js";
import { modesTab } from "./modetable.js";
import { StrikePointer } from "./pointer.js";
import { renderOffline, SoundEngine } from "./sound.js";
import { strikeTab } from "./strike.js";
import { Studio } from "./studio.js";

const at = (name) => document.getElementById(name);
const UPS = ["z", "y", "x"];
const HINT = {
  capture: "<strong>Click the object</strong> where you will strike it",
  field: "<strong>Click the object</strong> to strike it. Hold longer for more force. Drag to rotate.",
};

async function open() {
  // The 3D library is by far the largest part: it is fetched during all else, and by itself, so that the panel works
  // where it cannot be loaded.
  const library = import("./objectview.js");
  library.catch(() => {});
  const studio = new Studio(await loadBundle());
  window.avmsf.studio = studio;
  const mode = studio.live?.mode ?? "field";
  studio.on("bundle", () => showTitle(studio));
  const sound = mode === "field" ? startSound(studio) : null;
  const panel = await (mode === "field" ? fieldTabs(studio) : captureTabs(studio));
  await showObject(studio, panel, library);
  await sound;
  studio.dispatchEvent(new Event("view"));
  at("hint").hidden = !studio.view;
  at("hint").innerHTML = HINT[mode];
  takeDrops(panel);
  // It can be struck from now on, and seen from the next frame.
  await new Promise((drawn) => requestAnimationFrame(drawn));
  window.avmsf.readyAt = performance.now();
  return studio;
}

function showTitle({ bundle: { manifest }, live }) {
  const { name, modes: poles, points, sampleRate, supporting = [] } = manifest;
  at("name").textContent = name;
  document.title = live ? `${name} · avmsf studio` : name;
  const facts = [
    poles ? `${poles - supporting.length} modes` : null,
    points ? `${points.toLocaleString("en")} contacts` : null,
    poles ? `${Math.round(sampleRate / 100) / 10} kHz` : null,
  ];
  at("facts").textContent = facts.filter(Boolean).join(" · ");
}

async function startSound(studio) {
  at("charts").hidden = false;
  studio.spectra = new SpectrumView(at("spectrum"), at("decay"));
  // The panel can be used before there is sound.
  studio.spectra.listen(studio.modes, null);
  try {
    studio.engine = await SoundEngine.start(studio.bundle);
  } catch (error) {
    say(`No sound: ${error.message}. The charts still show the model.`, { name: "sound", bad: true });
    at("output").textContent = "output (no sound)";
  }
  studio.on("bundle", () => studio.spectra.listen(studio.modes, studio.engine));
}

async function fieldTabs(studio) {
  const strike = strikeTab(studio);
  studio.on("bundle", () => {
    for (const control of strike.element.querySelectorAll("button")) control.disabled = studio.contacts.count === 0;
  });
  const locate = studio.can("locate") ? locateTab(studio) : null;
  const capture = studio.can("capture") ? await captureTab(studio) : null;
  const tabs = [
    { name: "strike", words: "Strike", ...strike },
    { name: "modes", words: "Modes", ...modesTab(studio) },
  ];
  if (locate) tabs.push({ name: "find", words: "Locate", ...locate });
  if (studio.can("edit")) tabs.push({ name: "edit", words: "Edit", ...editTab(studio, () => reload(studio)) });
  if (capture) tabs.push({ name: "capture", words: "Capture", ...capture });
  const show = makeTabs(tabs);
  const capturing = () => capture !== null && !capture.element.hidden;
  return {
    atPress: () => !capturing() && strike.atPress(),
    strike: (hit, factor) => (capturing() ? capture.choose(hit) : studio.strike(hit.row, { factor })),
    take: locate && ((file) => (capturing() ? capture.take(file) : (show("find"), locate.take(file)))),
  };
}

async function captureTabs(studio) {
  const capture = await captureTab(studio);
  makeTabs([{ name: "capture", words: "Capture", ...capture }]);
  if (studio.contacts.count <= 1) sayNoObject(studio.live);
  return { atPress: () => false, strike: (hit) => capture.choose(hit), take: capture.take };
}

function sayNoObject({ jobKind, noObject }) {
  const name = "object";
  const again = async () => (await attempt(() => server.makeObject(), name)) && location.reload();
  if (jobKind === "make_object")
    say("No object to click yet: it is being reconstructed from the images. Until then, enter coordinates.", { name });
  else if (noObject) {
    const words = `No object to click: the reconstruction from the images failed: ${noObject}`;
    say(words, { name, bad: true, answers: [["Try again", again]] });
  } else say("No object to click: enter coordinates.", { name });
}

/** Fetch what the server now has; after an edit, say, or when another tab was faster. */
async function reload(studio) {
  const bundle = await loadBundle();
  await studio.view?.replace(bundle);
  await studio.engine?.replace(bundle);
  studio.take(bundle);
}

async function showObject(studio, { atPress, strike }, library) {
  try {
    const { ObjectView } = await library;
    studio.view = await ObjectView.create(at("stage"), at("overlay"), studio.bundle);
  } catch (error) {
    say(error.message, { name: "view", bad: true });
    return;
  }
  const { view } = studio;
  at("stage").append(element("div", { className: "crosshair" }));
  new StrikePointer(view, {
    strike: (hit, factor) => {
      at("hint").hidden = true;
      strike(hit, factor);
    },
    hover: (hit) => view.canvas.classList.toggle("over-object", hit !== null),
    atPress,
  });
  at("tools").hidden = false;
  at("reset-view").addEventListener("click", () => view.eye.look(view.contacts, view.eye.up));
  at("upright").addEventListener("click", () => {
    const up = UPS[(UPS.indexOf(view.eye.up) + 1) % UPS.length];
    view.eye.look(view.contacts, up);
    at("upright").textContent = `Up: ${up}`;
  });
  const names = { gaussians: "Gaussians", mesh: "mesh", points: "points" };
  const label = () => {
    const { object, surface } = view.bundle.manifest;
    at("other-source").hidden = !surface;
    at("other-source").textContent = `Show ${view.source === "surface" ? names[object.kind] : "surface"}`;
  };
  studio.on("bundle", label);
  at("other-source").addEventListener("click", async () => {
    await attempt(() => view.showAs(view.source === "surface" ? "object" : "surface"), "view");
    label();
  });
  at("unpaint").addEventListener("click", () => {
    studio.choose(null);
    studio.paint(null);
  });
}

/** A WAV file may be dropped anywhere; where there is nothing to do with it, it must not replace the page. */
function takeDrops({ take }) {
  const target = at("drop-target");
  window.addEventListener("dragover", (event) => {
    if (![...(event.dataTransfer?.types ?? [])].includes("Files")) return;
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

/** For scripts and tests: what the pointer can do. */
window.avmsf = {
  ready: null,
  /** Strike a contact, by its row or by a position on the object, meters. */
  strike(contact, { force = 1, contactTime = null } = {}) {
    const { studio } = window.avmsf;
    const row = typeof contact === "number" ? contact : studio.contacts.nearest(contact).row;
    studio.strike(row, { force, contactTime });
    return row;
  },
  /** The sound of strikes [{row, force, contactTime, when}], from the bank that plays. */
  renderOffline: (strikes, ...more) => renderOffline(window.avmsf.studio.bundle, strikes, ...more),
  pick: (clientX, clientY) => window.avmsf.studio.view.pick(clientX, clientY),
  project: (position) => window.avmsf.studio.view.project(position),
  /** Values and colors that the contacts are painted by; null without paint. */
  painted: () => window.avmsf.studio.view.painted,
};

window.avmsf.ready = open().catch((error) => {
  at("name").textContent = "Nothing to show";
  say(error.message, { name: "open", bad: true, answers: [["Reload", () => location.reload()]] });
  throw error;
});
