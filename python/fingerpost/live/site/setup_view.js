// A view during set-up: picture, four draggable corners, the detected hand, and a template to hold
// the hand up to.

import { awayFrom, html, make, middleOf, path, place } from "./draw.js";
import { setText } from "./status.js";

export const CORNERS = 4;

const ZOOM = 4;
const LOUPE_GAP_PX = 26;
const GRIP_PX = 22;
const FAR_PX = 10;
const TURN_DEG = 3;
const SCALE = 1.05;
const LENGTH_SHARE = 0.25; // initial length of a template, relative to the picture's height
const START_INSET = 0.3;

const $ = (id) => document.getElementById(id);
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

export class SetUpView {
  // changed(): called after a change of corners or template
  constructor(parent, offer, number, templates, changed) {
    Object.assign(this, { offer, number, templates, changed });
    this.size = offer.size;
    this.points = [];
    this.held = null;
    this.build(parent);
    this.listen();
    new ResizeObserver(() => this.draw()).observe(this.svg);
    this.draw();
  }

  build(parent) {
    this.element = html("section", "pane", parent);
    this.element.setAttribute("aria-label", `View ${this.offer.name}`);
    const head = html("header", "", this.element);
    this.swatch = html("i", "swatch", head);
    html("h2", "", head, this.offer.name);
    this.state = html("span", "left", head);
    this.put = html("button", "put", head, "Put corners");
    this.put.type = "button";
    this.put.addEventListener("click", () => this.putCorners());
    const [width, height] = this.size;
    this.element.style.setProperty("--aspect", `${width} / ${height}`);
    this.svg = make("svg", { viewBox: `-0.5 -0.5 ${width} ${height}`, preserveAspectRatio: "xMinYMin", role: "group", "aria-label": `Picture of ${this.offer.name}` });
    this.element.append(this.svg);
    this.picture = make("image", { x: -0.5, y: -0.5, width, height, preserveAspectRatio: "none" }, this.svg);
    this.image = new Image();
    this.quad = make("path", { class: "quad" }, this.svg);
    for (const name of ["contour case", "contour tracking", "finger case", "finger"]) this[name.replaceAll(" ", "_")] = make("path", { class: name }, this.svg);
    this.buildTemplate();
    this.handles = [];
    this.caption = html("p", "caption", this.element);
  }

  colour(index) {
    this.swatch.style.background = `var(--view-${index % 4})`;
    this.finger.style.stroke = `var(--shown-${index % 4})`;
  }

  show(version) {
    if (version === this.version) return;
    this.version = version;
    const next = new Image();
    next.src = `still/${this.number}.jpg?${version}`;
    next.addEventListener("load", () => {
      this.image = next;
      this.picture.setAttribute("href", next.src);
    });
  }

  // Shows corners in the table step, hand and template in the hand step.
  enter(step) {
    this.step = step;
    this.element.dataset.step = step;
    for (const { group } of this.handles) group.setAttribute("tabindex", step === "table" ? 0 : -1);
    this.draw();
  }

  // --- corners ---

  // Takes corners detected by the program; corners placed by hand are kept.
  take({ points, sigma, found, missing }) {
    this.accuracy = sigma === null ? "" : found ? `found ± ${sigma} px` : `by hand, ± ${sigma} px`;
    this.missing = missing;
    if (!this.isByHand && points.length === CORNERS && this.points.length < CORNERS) {
      this.points = points.map((point) => [...point]);
      this.isByHand = !found;
    }
    this.draw();
  }

  clear(isByHand) {
    this.isByHand = isByHand;
    this.points = [];
    for (const { group } of this.handles.splice(0)) group.remove();
    this.draw();
  }

  putCorners() {
    this.isByHand = true;
    const [width, height] = this.size;
    const [low, high] = [START_INSET, 1 - START_INSET];
    this.points = [[low, high], [high, high], [high, low], [low, low]].map(([u, v]) => [u * width, v * height].map(Math.round));
    this.draw();
    this.handles[0].group.focus();
    this.changed();
  }

  listen() {
    this.svg.addEventListener("pointerdown", (event) => {
      if (this.step !== "table") return;
      const grabbed = this.handles.findIndex((handle) => handle.group.contains(event.target));
      if (grabbed < 0 && this.points.length >= CORNERS) return;
      this.dragged = grabbed >= 0 ? grabbed : this.points.push(this.at(event)) - 1;
      this.svg.setPointerCapture(event.pointerId);
      this.move(event, grabbed >= 0);
      event.preventDefault();
    });
    this.svg.addEventListener("pointermove", (event) => this.dragged !== undefined && this.move(event));
    for (const end of ["pointerup", "pointercancel"]) {
      this.svg.addEventListener(end, () => {
        if (this.dragged === undefined) return;
        this.handles[this.dragged].group.focus({ preventScroll: true });
        this.dragged = undefined;
        $("loupe").hidden = true;
        this.changed();
      });
    }
  }

  // Pixel coordinates of the pointer in the view.
  at(event) {
    const point = new DOMPoint(event.clientX, event.clientY).matrixTransform(this.svg.getScreenCTM().inverse());
    return this.within([point.x, point.y]);
  }

  within(point) {
    return point.map((value, axis) => Math.min(Math.max(Math.round(10 * value) / 10, -0.5), this.size[axis] - 0.5));
  }

  move(event, isGrab = false) {
    if (!isGrab) {
      this.points[this.dragged] = this.at(event);
      this.isByHand = true;
    }
    this.draw();
    this.magnify(this.dragged, event.clientX, event.clientY);
  }

  magnify(k, x, y) {
    const loupe = $("loupe");
    const [u, v] = this.points[k];
    const scale = this.image.naturalWidth / this.size[0];
    const context = loupe.getContext("2d");
    const side = loupe.width / ZOOM;
    context.fillStyle = "#11161c";
    context.fillRect(0, 0, loupe.width, loupe.height);
    context.drawImage(this.image, (u + 0.5) * scale - side / 2, (v + 0.5) * scale - side / 2, side, side, 0, 0, loupe.width, loupe.height);
    const middle = loupe.width / 2;
    for (const [width, colour] of [[4, "#11161c"], [1.5, "#ecf0f3"]]) {
      context.lineWidth = width;
      context.strokeStyle = colour;
      context.stroke(new Path2D(`M${middle} 10V${middle - 8}M${middle} ${middle + 8}V${2 * middle - 10}M10 ${middle}H${middle - 8}M${middle + 8} ${middle}H${2 * middle - 10}`));
    }
    loupe.hidden = false;
    const left = Math.min(Math.max(x - middle, 4), innerWidth - loupe.width - 4);
    const above = y - loupe.height - LOUPE_GAP_PX;
    Object.assign(loupe.style, { left: `${left}px`, top: `${above > 4 ? above : y + LOUPE_GAP_PX}px` });
  }

  handle(k) {
    const group = make("g", { class: "handle numbered", tabindex: 0, role: "button", "aria-label": `Corner ${k + 1} in ${this.offer.name}; arrow keys move it` }, this.svg);
    make("circle", { class: "grip", r: GRIP_PX }, group);
    make("circle", { class: "mark-case", r: 6 }, group);
    make("circle", { class: "mark", r: 6 }, group);
    const label = make("g", {}, group);
    make("circle", { r: 9.5, class: "disc" }, label);
    make("text", { "text-anchor": "middle", dy: "0.36em" }, label).textContent = k + 1;
    group.addEventListener("keydown", (event) => {
      const by = ARROWS[event.key];
      if (!by) return;
      event.preventDefault();
      const far = event.shiftKey ? FAR_PX : 1;
      this.isByHand = true;
      this.points[k] = this.within(this.points[k].map((value, axis) => value + far * by[axis]));
      this.draw();
      const box = group.querySelector(".mark").getBoundingClientRect();
      this.magnify(k, box.x + box.width / 2, box.y + box.height / 2);
      clearTimeout(this.settled);
      this.settled = setTimeout(() => this.changed(), 400);
    });
    group.addEventListener("blur", () => ($("loupe").hidden = true));
    return { group, label };
  }

  // --- hand and template ---

  showHand(seen) {
    this.seen = seen;
    this.draw();
  }

  buildTemplate() {
    this.template = make("g", { class: "template", tabindex: -1, role: "button", "aria-label": `Template in ${this.offer.name}; arrow keys move it, brackets turn it, plus and minus scale it` }, this.svg);
    make("path", { class: "template-case" }, this.template);
    make("path", { class: "template-line" }, this.template);
    this.turnGrip = make("g", { class: "turn" }, this.template);
    make("circle", { class: "grip", r: GRIP_PX }, this.turnGrip);
    make("circle", { class: "mark-case", r: 8 }, this.turnGrip);
    make("circle", { class: "mark", r: 8 }, this.turnGrip);
    place(this.template, null);
    let from = null;
    this.template.addEventListener("pointerdown", (event) => {
      from = { at: this.at(event), held: structuredClone(this.held), turns: this.turnGrip.contains(event.target) };
      this.template.setPointerCapture(event.pointerId);
      event.preventDefault();
    });
    this.template.addEventListener("pointermove", (event) => from && this.drag(from, this.at(event)));
    for (const end of ["pointerup", "pointercancel"]) {
      this.template.addEventListener(end, () => {
        if (from) this.changed();
        from = null;
      });
    }
    this.template.addEventListener("keydown", (event) => this.nudge(event));
  }

  // Dragging the knuckle rotates and scales the template about its tip.
  drag({ at, held, turns }, now) {
    if (!turns) this.held.tip_px = this.within(held.tip_px.map((value, axis) => value + now[axis] - at[axis]));
    else {
      const away = held.tip_px.map((value, axis) => value - now[axis]);
      this.held.angle_deg = Math.round((Math.atan2(away[1], away[0]) * 1800) / Math.PI) / 10;
      this.held.length_px = Math.max(Math.round(10 * Math.hypot(...away)) / 10, 5);
    }
    this.draw();
  }

  nudge(event) {
    const { held } = this;
    const by = ARROWS[event.key];
    if (by) held.tip_px = this.within(held.tip_px.map((value, axis) => value + (event.shiftKey ? FAR_PX : 1) * by[axis]));
    else if (event.key === "[" || event.key === "]") held.angle_deg += event.key === "[" ? -TURN_DEG : TURN_DEG;
    else if (event.key === "+" || event.key === "-") held.length_px *= event.key === "+" ? SCALE : 1 / SCALE;
    else return;
    event.preventDefault();
    this.draw();
    clearTimeout(this.settled);
    this.settled = setTimeout(() => this.changed(), 400);
  }

  // Places a template at the detected hand, or in the middle.
  hold(thumb) {
    const [width, height] = this.size;
    const { tip, finger, length } = this.seen ?? {};
    const along = finger?.[0] ? [finger[0][2] - finger[0][0], finger[0][3] - finger[0][1]] : [1, 1];
    this.held = this.held ?? {
      tip_px: tip ?? [width / 2, height / 2],
      angle_deg: Math.round((Math.atan2(along[1], along[0]) * 1800) / Math.PI) / 10,
      length_px: length ?? Math.round(LENGTH_SHARE * height),
    };
    this.held.thumb = thumb;
    this.draw();
  }

  letGo() {
    this.held = null;
    this.draw();
  }

  // --- drawing ---

  get scale() {
    const { clientWidth, clientHeight } = this.svg;
    return this.size[0] / Math.max(Math.min(clientWidth, (clientHeight * this.size[0]) / this.size[1]), 1);
  }

  draw() {
    const isHand = this.step !== "table";
    while (this.handles.length < this.points.length) this.handles.push(this.handle(this.handles.length));
    const middle = middleOf(this.points);
    this.handles.forEach(({ group, label }, k) => {
      place(group, isHand ? null : this.points[k], this.scale);
      if (this.points[k]) label.setAttribute("transform", `translate(${awayFrom(middle, this.points[k], 19)})`);
    });
    this.quad.setAttribute("d", this.points.length > 1 ? path([this.points.flat()], null, this.points.length === CORNERS) : "");
    this.put.hidden = isHand || this.points.length > 0;
    for (const name of ["contour_case", "contour_tracking"]) this[name].setAttribute("d", isHand ? path(this.seen?.contour) : "");
    for (const name of ["finger_case", "finger"]) this[name].setAttribute("d", isHand ? path(this.seen?.finger) : "");
    this.drawTemplate(this.step === "hand");
    this.sayState(isHand);
  }

  drawTemplate(isShown) {
    const held = isShown ? this.held : null;
    place(this.template, held && held.tip_px);
    this.template.setAttribute("tabindex", held ? 0 : -1);
    if (!held) return;
    const outline = this.templates[held.thumb];
    const [cos, sin] = [Math.cos((held.angle_deg * Math.PI) / 180) * held.length_px, Math.sin((held.angle_deg * Math.PI) / 180) * held.length_px];
    const d = path([outline], (x, y) => [cos * x - sin * y, sin * x + cos * y]);
    for (const line of this.template.querySelectorAll("path")) line.setAttribute("d", d);
    place(this.turnGrip, [-cos, -sin], this.scale);
  }

  sayState(isHand) {
    const count = this.points.length;
    const corners = count < CORNERS ? `${count} of ${CORNERS} corners` : (this.accuracy ?? "");
    const hand = this.seen ? (this.seen.tip ? "hand found" : "no hand yet") : "";
    setText(this.state, isHand ? hand : corners);
    const words = isHand ? (this.seen?.words ?? "") : count < CORNERS ? (this.missing ?? "") : "";
    setText(this.caption, words);
    this.caption.hidden = !words;
  }
}
