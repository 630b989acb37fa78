// The plan alone, for a projector above the table; its corners are dragged onto those of the plane.

import { html } from "./draw.js";
import { TargetsOnPlan } from "./experiment.js";
import { Link } from "./link.js";
import { PlanPanel } from "./plan.js";
import { ArmOnPlan } from "./robot.js";
import { homography, isConvex, matrix3d } from "./warp.js";

const KEPT = "plan-corners";
const STEP_PX = 1;
const LARGE_STEP_PX = 20;
const HIDDEN_AFTER_MS = 6000;
const EMPHASIS = 2;

if (location.search) history.replaceState(null, "", location.pathname);

const root = document.documentElement;
const sheet = document.getElementById("sheet");
const arm = new ArmOnPlan();
const targets = new TargetsOnPlan();
let plan = null;
let corners = null;

const link = new Link({
  withoutPictures: true,
  onMoment: (scene) => plan?.show(scene.plan, scene.head.status),
  onState: (state) => {
    if (state.rig) open(state.rig);
    if (state.arm) arm.show(state.arm);
    targets.show(state.experiment);
    root.classList.toggle("stale", Boolean(plan?.rig.live && state.ended));
  },
  onRefused: () => {},
  // Without a connection, no point is shown as if it were the present one.
  onConnected: (connected) => ["cut-off", "stale"].forEach((name) => root.classList.toggle(name, !connected)),
});

function open(rig) {
  sheet.replaceChildren();
  plan = new PlanPanel(sheet, rig);
  arm.attach(plan);
  targets.attach(plan);
  document.title = `${rig.title}: plan – fingerpost`;
  layOut();
}

// The plan is drawn at the size of the window, then warped.
function layOut() {
  if (!plan) return;
  plan.put({ left: 0, top: 0, width: innerWidth, height: innerHeight }, EMPHASIS);
  corners ??= kept() ?? drawn();
  warp();
}

// Positions of the plane's corners in the window without warping: its reference points if they are
// four, else the corners of their bounding rectangle.
function drawn() {
  sheet.style.transform = "";
  const { left, top } = plan.body.getBoundingClientRect();
  const places = plan.rig.points.map(([x, y]) => {
    const [u, v] = plan.map(x, y);
    return [u + left + plan.margin.left, v + top + plan.margin.top];
  });
  const { hull } = plan.rig;
  const isFour = hull.length === 4 && places.length === 4;
  handles.forEach((handle, k) => (handle.textContent = (isFour ? hull[k] : k) + 1));
  if (isFour) return hull.map((k) => places[k]);
  const [us, vs] = [0, 1].map((axis) => places.map((place) => place[axis]));
  const [u0, u1, v0, v1] = [Math.min(...us), Math.max(...us), Math.min(...vs), Math.max(...vs)];
  return [[u0, v0], [u1, v0], [u1, v1], [u0, v1]];
}

function warp() {
  const map = homography(drawn(), corners);
  if (map) sheet.style.transform = matrix3d(map);
  handles.forEach((handle, k) => {
    handle.style.left = `${corners[k][0]}px`;
    handle.style.top = `${corners[k][1]}px`;
  });
}

function move(k, corner) {
  const next = corners.map((each, i) => (i === k ? corner.map((px, axis) => Math.min(Math.max(px, 0), [innerWidth, innerHeight][axis])) : each));
  if (!isConvex(next)) return;
  corners = next;
  localStorage.setItem(KEPT, JSON.stringify(corners.map(([u, v]) => [u / innerWidth, v / innerHeight])));
  warp();
}

function kept() {
  const said = JSON.parse(localStorage.getItem(KEPT) ?? "null");
  return said && said.map(([u, v]) => [u * innerWidth, v * innerHeight]);
}

const handles = [0, 1, 2, 3].map((k) => {
  const handle = html("button", "corner", document.body, String(k + 1));
  handle.title = "Drag this corner, or move it by the arrows";
  handle.addEventListener("pointerdown", (event) => {
    handle.setPointerCapture(event.pointerId);
    const away = [event.clientX - corners[k][0], event.clientY - corners[k][1]];
    const drag = ({ clientX, clientY }) => move(k, [clientX - away[0], clientY - away[1]]);
    handle.addEventListener("pointermove", drag);
    handle.addEventListener("lostpointercapture", () => handle.removeEventListener("pointermove", drag), { once: true });
  });
  handle.addEventListener("keydown", (event) => {
    const step = event.shiftKey ? LARGE_STEP_PX : STEP_PX;
    const by = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, -step], ArrowDown: [0, step] }[event.key];
    if (!by) return;
    move(k, [corners[k][0] + by[0], corners[k][1] + by[1]]);
    event.preventDefault();
  });
  return handle;
});

// Corners and messages are visible during interaction.
let timer = null;
function wake() {
  root.classList.add("awake");
  clearTimeout(timer);
  timer = setTimeout(() => root.classList.remove("awake"), HIDDEN_AFTER_MS);
}

addEventListener("pointermove", wake);
addEventListener("pointerdown", wake);
addEventListener("resize", () => {
  corners = null;
  layOut();
});
addEventListener("keydown", (event) => {
  wake();
  const number = Number(event.key);
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  if (event.key === " " || event.key === "Escape") link.send({ do: "stop" });
  else if (number >= 1 && number <= 4) handles.find((handle) => handle.textContent === event.key).focus();
  else if (event.key === "f") document.fullscreenElement ? document.exitFullscreen() : root.requestFullscreen();
  else if (event.key === "r") {
    localStorage.removeItem(KEPT);
    corners = drawn();
    warp();
  } else return;
  event.preventDefault();
}, true);
wake();
