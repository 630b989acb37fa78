// The operator's page: connection, stage and status line.

import { Experiment } from "./experiment.js";
import { bindKeys } from "./keys.js";
import { Link } from "./link.js";
import { Robot } from "./robot.js";
import { SetUp } from "./setup.js";
import { Stage } from "./stage.js";
import { StatusLine, setText } from "./status.js";
import { Bookmarks, Timeline } from "./timeline.js";

const $ = (id) => document.getElementById(id);
const REFUSED_FOR_MS = 5000;

// From here on the token is in a cookie; a copied or visible address does not disclose it.
if (location.search) history.replaceState(null, "", location.pathname);

const stage = new Stage($("stage"));
const statusLine = new StatusLine();
const timeline = new Timeline($("strip"), $("cursor"));
const bookmarks = new Bookmarks($("line"), (number) => seek(number));
let state = null;
let rig = null;
let isConnected = false;
let refusal = { words: "", until: 0 };

const setUp = new SetUp((command) => link.send(command));
const robot = new Robot($("robot"), (command) => link.send(command), onRefused);
const experiment = new Experiment($("experiment"), $("tools"), (command) => link.send(command));
const link = new Link({ onMoment, onState, onRefused, onConnected });

function onMoment(scene, pictures) {
  if (!rig) return;
  stage.show(scene, pictures);
  statusLine.show(scene);
  timeline.move(scene.number);
  setText($("clock"), clock(scene));
  if (document.activeElement !== $("scrub") || !scrubbing) $("scrub").value = scene.number;
}

function onState(received) {
  if (received.rig) openRig(received.rig);
  state = received;
  document.documentElement.classList.toggle("setting-up", Boolean(received.setup));
  experiment.show(received.experiment, !received.setup);
  if (received.setup) return setUp.show(received.setup);
  setUp.hide();
  if (!rig) return;
  showStale();
  robot.show(received.arm, received.controls);
  timeline.take(received);
  bookmarks.setTotal(received.total);
  statusLine.isPlaying = received.playing;
  statusLine.stand(rig.live && !received.playing && !received.ended);
  statusLine.latency(received.latency_ms);
  $("scrub").max = Math.max(received.total - 1, 0);
  showPlaying(received.playing);
  showNotes(received.notes);
  showMessage();
}

function openRig(opened) {
  rig = opened;
  document.documentElement.classList.toggle("live", rig.live);
  document.title = `${rig.title} – fingerpost`;
  stage.open(rig);
  robot.attach(stage.plan);
  experiment.attach(stage.plan, rig.unit);
  stage.showEdges($("edges").ariaPressed === "true");
  statusLine.open(rig);
  timeline.open(rig);
  bookmarks.open(rig);
}

function onRefused(words) {
  refusal = { words, until: performance.now() + REFUSED_FOR_MS };
  setUp.refuse(words);
  showMessage();
}

function onConnected(connected) {
  isConnected = connected;
  document.documentElement.classList.toggle("cut-off", !connected);
  if (!connected) robot.letGo();
  setUp.connect(connected);
  if (!setUp.isOpen) showStale();
  showMessage();
}

// Without a connection, and after the last frame of cameras, the last moment is past.
function showStale() {
  const why = !isConnected ? { badge: "cut off", words: "no connection", detail: "if fingerpost was started anew, open the address that it prints" } : rig?.live && state?.ended ? { badge: "ended", words: "ended", detail: state.ended } : null;
  document.documentElement.classList.toggle("stale", Boolean(why));
  statusLine.halt(why);
}

function clock(scene) {
  const time = rig.live ? "" : `${scene.time.toFixed(2)} s`;
  return `${time}  frame ${scene.frame}`.trim();
}

function showPlaying(playing) {
  const ended = rig.live && Boolean(state.ended);
  document.documentElement.classList.toggle("stopped", !playing && !ended);
  const words = playing ? "Stand still" : rig.live ? "Continue" : "Play";
  $("play-mark").setAttribute("href", `#mark-${playing ? "pause" : "play"}`);
  $("play").setAttribute("aria-label", words);
  $("play").title = `${words} (P)`;
  $("play").disabled = ended;
}

// The most urgent message, in one line.
function showMessage() {
  let words = "";
  if (!isConnected) words = "No connection to fingerpost. If it was started anew, open the address that it prints.";
  else if (performance.now() < refusal.until) words = refusal.words;
  else if (state && !state.playing && rig?.live && !state.ended) words = "Stopped: no picture is looked at. P goes on.";
  else if (state?.ended && rig?.live) words = `Ended: ${state.ended}`;
  else if (state && !state.controls) words = "Another page has the control; C takes it over.";
  else if (state?.ended && !state.playing && state.shown >= state.total - 1) words = `${state.ended}; P plays it again.`.replace(/^./, (c) => c.toUpperCase());
  else if (state?.notes.length) words = state.notes.at(-1);
  else if (rig) words = rig.title;
  setText($("message"), words);
  $("message").title = words;
}

function showNotes(notes) {
  if (notes.length === Number($("notes").dataset.count)) return;
  $("notes").dataset.count = notes.length;
  const said = notes.length ? notes : ["nothing to note"];
  $("notes").replaceChildren(...said.map((note) => Object.assign(document.createElement("li"), { textContent: note })));
}

// --- operator actions ------------------------------------------------------------------------

let scrubbing = false;
const stop = () => {
  link.send({ do: "stop" });
  robot.letGo();
};
const toggle = () => (state?.playing ? stop() : link.send({ do: "play" }));
const step = (by) => rig && !rig.live && link.send({ do: "step", by });
const seek = (number) => rig && !rig.live && link.send({ do: "seek", number });
const press = (button) => {
  const pressed = button.ariaPressed !== "true";
  button.ariaPressed = String(pressed);
  return pressed;
};
const large = () => {
  const isLarge = press($("large"));
  document.documentElement.classList.toggle("large", isLarge);
  stage.enlarge(isLarge);
};
const explain = () => {
  const explains = stage.views.some((view) => !view.explains);
  for (const view of stage.views) view.explain(explains);
};
const edges = () => stage.showEdges(press($("edges")));
const help = () => ($("help").open ? $("help").close() : $("help").showModal());

function theme() {
  const isDark = getComputedStyle(document.documentElement).colorScheme.startsWith("dark");
  setTheme(isDark ? "light" : "dark");
}

function setTheme(name) {
  document.documentElement.dataset.theme = name;
  localStorage.setItem("theme", name);
  timeline.draw();
}

if (localStorage.getItem("theme")) setTheme(localStorage.getItem("theme"));
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => timeline.draw());

$("stop").addEventListener("pointerdown", stop);
$("stop").addEventListener("click", stop);
$("play").addEventListener("click", toggle);
$("back").addEventListener("click", () => step(-1));
$("forward").addEventListener("click", () => step(1));
$("large").addEventListener("click", large);
$("edges").addEventListener("click", edges);
$("theme").addEventListener("click", theme);
$("help-open").addEventListener("click", help);
$("scrub").addEventListener("pointerdown", () => {
  scrubbing = true;
  stop();
});
addEventListener("pointerup", () => {
  if (scrubbing && rig) for (const k of timeline.lostAt(Number($("scrub").value))) stage.views[k].explain(true);
  scrubbing = false;
});
$("scrub").addEventListener("input", () => seek(Number($("scrub").value)));

bindKeys({
  setUp: (event) => {
    if (event.key === "?") help();
    else if (event.key === "t") theme();
    else setUp.key(event);
  },
  stop,
  toggle,
  step,
  seek,
  last: () => seek((state?.total ?? 1) - 1),
  large,
  edges,
  theme,
  help,
  take: () => link.send({ do: "take" }),
  bookmark: () => bookmarks.toggle(timeline.shown),
  nextBookmark: (direction) => bookmarks.go(timeline.shown, direction),
  explain: () => explain(),
  focus: (number) => stage.plan && stage.focus(number),
});
