// The arm: armed by a command, moved while a key or button is held, stopped by everything else.

import { html, make, path, place, segments } from "./draw.js";
import { setText } from "./status.js";

const BEAT_MS = 50;
const ANSWER_MS = 1000;
const WISHES = [
  ["home", "Home", "O", "the arm finds its home position"],
  ["follow", "Follow", "F", "the arm goes where the hand points"],
  ["carry", "Pick and place", "B", "point at a block and stay, then at its new place"],
  ["undo", "Undo", "U", "the last step of picking and placing, backwards"],
  ["way", "Make way", "W", "the arm draws back from a hand that it hides"],
];
const ONCE = [
  ["select", "Select", "S", "select what is pointed at"],
  ["hand", "My hand", "Y", "the hand that is seen is yours: it may move the arm"],
];

export class Robot {
  // send(command) to the server; refuse(words) shows a refusal; element: an empty section.
  constructor(element, send, refuse) {
    this.element = element;
    this.send = send;
    this.refuse = refuse;
    this.arm = null;
    this.beats = null;
    this.holder = null;
    this.armedAt = -Infinity;
    this.layer = new ArmOnPlan();
    this.build();
    this.listen();
  }

  build() {
    this.hold = button(this.element, "hold", "Hold to move", "M", "the arm moves only while this is held");
    const row = html("div", "switches", this.element);
    this.armed = button(row, "armed", "Arm", "A", "the arm may move from now on, while it is held");
    this.wishes = html("div", "wishes", row);
    this.wishes.setAttribute("role", "group");
    this.wishes.setAttribute("aria-label", "What the arm does while it is held");
    const add = (parent) => ([wish, words, key, title]) => [wish, button(parent, wish, words, key, title)];
    this.buttons = Object.fromEntries([...WISHES.map(add(this.wishes)), ...ONCE.map(add(row))]);
    const said = html("div", "arm-said", this.element);
    this.doing = html("p", "doing", said);
    this.doing.setAttribute("role", "status");
    this.detail = html("p", "arm-detail", said);
  }

  listen() {
    const { hold } = this;
    hold.addEventListener("pointerdown", (event) => {
      if (event.button) return;
      hold.setPointerCapture(event.pointerId);
      this.take("pointer");
    });
    for (const end of ["pointerup", "pointercancel", "lostpointercapture"]) hold.addEventListener(end, () => this.letGo("pointer"));
    hold.addEventListener("contextmenu", (event) => event.preventDefault());
    this.armed.addEventListener("click", () => this.toggle());
    for (const [wish, each] of Object.entries(this.buttons)) each.addEventListener("click", () => this.ask(wish));
    addEventListener("blur", () => this.letGo());
    document.addEventListener("visibilitychange", () => document.hidden && this.letGo());
    addEventListener("pagehide", () => this.letGo());
    const keys = { a: () => this.toggle(), ...Object.fromEntries([...WISHES, ...ONCE].map(([wish, , key]) => [key.toLowerCase(), () => this.ask(wish)])) };
    addEventListener("keydown", (event) => {
      if (!this.arm || event.ctrlKey || event.metaKey || event.altKey) return;
      const key = event.key.toLowerCase();
      if (key === "m") event.repeat || this.take("key");
      else if (keys[key] && !event.repeat) keys[key]();
      else return;
      event.preventDefault();
    });
    addEventListener("keyup", (event) => event.key.toLowerCase() === "m" && this.letGo("key"));
  }

  // --- holding -------------------------------------------------------------------------------

  take(holder) {
    if (this.holder || !this.arm) return;
    // The server decides; its confirmation of arming may not have arrived yet.
    if (!this.arm.armed && performance.now() > this.armedAt + ANSWER_MS) return this.refuse("The arm is not armed: press Arm (A), then hold.");
    if (!this.controls) return this.refuse("Another page has the control; C takes it over.");
    this.holder = holder;
    this.send({ do: "beat" });
    this.beats = setInterval(() => this.send({ do: "beat" }), BEAT_MS);
    this.draw();
  }

  // Without an argument, any holder is released.
  letGo(holder = this.holder) {
    if (!this.holder || holder !== this.holder) return;
    clearInterval(this.beats);
    this.holder = null;
    this.send({ do: "release" });
    this.draw();
  }

  toggle() {
    if (this.arm) this.ask(this.arm.armed ? "disarm" : "arm");
  }

  ask(wish) {
    if (wish === "arm") this.armedAt = performance.now();
    if (this.arm && !this.buttons[wish]?.disabled) this.send({ do: "robot", what: wish });
  }

  // --- display -------------------------------------------------------------------------------

  attach(plan) {
    this.layer.attach(plan);
  }

  show(arm, controls) {
    document.documentElement.classList.toggle("with-arm", Boolean(arm));
    this.element.hidden = !arm;
    if (!arm) this.letGo();
    [this.arm, this.controls] = [arm, controls];
    if (!arm) return;
    this.draw();
    this.layer.show(arm);
  }

  draw() {
    const { arm } = this;
    if (!arm) return;
    const isHeld = Boolean(this.holder);
    this.element.dataset.state = arm.holds && !arm.why ? "moves" : arm.armed ? "ready" : "off";
    this.hold.setAttribute("aria-pressed", isHeld);
    this.hold.setAttribute("aria-disabled", !arm.armed);
    this.armed.setAttribute("aria-pressed", arm.armed);
    setText(this.armed.firstChild, arm.armed ? "Armed" : "Arm");
    for (const [wish] of WISHES) this.buttons[wish].setAttribute("aria-pressed", arm.wish === wish);
    this.buttons.carry.disabled = !arm.carries;
    this.buttons.undo.disabled = !arm.carrying;
    this.buttons.select.disabled = !arm.carries;
    this.buttons.hand.classList.toggle("asks", arm.stranger);
    setText(this.doing, arm.why || (arm.moves ? "moves" : arm.holds ? "stands where it is to be" : "stands"));
    const pose = arm.pose_mm ? ["X", "Y", "Z"].map((axis, k) => `${axis} ${arm.pose_mm[k].toFixed(1).replace("-", "−").padStart(6)}`).join("  ") + " mm" : "pose not read yet";
    setText(this.detail, arm.said ? `${pose}   ${arm.said}` : pose);
    this.detail.title = arm.said;
  }
}

function button(parent, name, words, key, title) {
  const element = html("button", `arm-${name}`, parent);
  element.type = "button";
  element.title = `${title} (${key})`;
  element.setAttribute("aria-keyshortcuts", key);
  html("span", "", element, words);
  html("kbd", "", element, key).setAttribute("aria-hidden", "true");
  return element;
}

// The arm from above, its safe region, and the progress ring of a dwell.
export class ArmOnPlan {
  attach(plan) {
    this.plan = plan;
    this.region = make("path", { class: "arm-region" }, plan.under);
    this.parts = make("g", { class: "arm-body" }, plan.under);
    this.place = make("path", { class: "place", d: "M-9 0H9M0 -9V9" }, plan.under);
    this.block = make("path", { class: "block" }, plan.under);
    this.gripper = make("path", { class: "gripper", d: "M-11 0H-4M4 0H11M0 -11V-4M0 4V11" }, plan.under);
    this.ring = make("circle", { class: "dwell", r: 15, pathLength: 1 }, plan.window);
    place(this.gripper, null);
    place(this.place, null);
    drawRing(this.ring, plan, 0);
    plan.layers.push(this);
    if (this.arm) this.draw();
  }

  show(arm) {
    this.arm = arm;
    if (this.plan?.map) this.draw();
  }

  draw() {
    const { arm, plan } = this;
    if (!arm || !plan.map) return;
    this.region.setAttribute("d", path([arm.region.flat()], plan.map, true));
    while (this.parts.childElementCount < arm.body.length) make("path", {}, this.parts);
    [...this.parts.children].forEach((part, k) => {
      const [x1, y1, x2, y2, radius] = arm.body[k] ?? [];
      part.setAttribute("d", radius ? segments([...plan.map(x1, y1), ...plan.map(x2, y2)]) : "");
      part.style.strokeWidth = `${2 * (radius ?? 0) * plan.pxPerUnit}px`;
    });
    // The plane of a rig with an arm has the arm's X and Y in metres.
    place(this.gripper, arm.pose_mm && plan.map(arm.pose_mm[0] / 1000, arm.pose_mm[1] / 1000), plan.emphasis);
    this.block.setAttribute("d", arm.block ? path([arm.block.flat()], plan.map, true) : "");
    place(this.place, arm.place && plan.map(...arm.place), plan.emphasis);
    drawRing(this.ring, plan, arm.dwell);
  }
}

// The elapsed fraction of a dwell, around the indicated point or another position in the window.
export function drawRing(ring, plan, share, place = null) {
  const at = share > 0 && plan.last?.point ? place ?? plan.map(...plan.last.point) : null;
  ring.style.display = at ? "" : "none";
  if (!at) return;
  ring.setAttribute("transform", `translate(${at}) rotate(-90) scale(${plan.emphasis})`);
  ring.setAttribute("stroke-dasharray", `${share} 2`);
}
