// Set-up without typing: pick views, click the same four corners in each, save, begin.

import { awayFrom, html, make, middleOf, path, place } from "./draw.js";
import { setText } from "./status.js";

const CORNERS = 4;
const ZOOM = 4;
const LOUPE_GAP_PX = 26;
const GRIP_PX = 22;

const $ = (id) => document.getElementById(id);

export class SetUp {
  // send(command)
  constructor(send) {
    this.send = send;
    this.offers = [];
    this.picked = [];
    $("sheet").addEventListener("change", () => ($("sides").hidden = $("sheet").value !== ""));
    $("plane").addEventListener("submit", (event) => {
      event.preventDefault();
      this.begin();
    });
  }

  show(setup) {
    const isNew = JSON.stringify(setup.offers) !== this.known;
    this.known = JSON.stringify(setup.offers);
    this.problem = setup.problem;
    this.isBusy = Boolean(setup.busy);
    $("setup").hidden = false;
    if (isNew) this.offer(setup.offers);
    this.say();
  }

  offer(offers) {
    this.offers = offers;
    this.picked = [];
    $("clicked").replaceChildren();
    $("offers").replaceChildren(...offers.map((offer, k) => this.button(offer, k)));
  }

  button(offer, k) {
    const button = html("button", "offer");
    button.type = "button";
    button.disabled = Boolean(offer.problem);
    button.ariaPressed = "false";
    const image = html("img", "", button);
    image.alt = "";
    if (!offer.problem) image.src = `still/${k}.jpg`;
    html("b", "", button, offer.name);
    html("small", "", button, offer.problem || `${offer.size[0]} × ${offer.size[1]}`);
    button.title = offer.problem || offer.source;
    button.addEventListener("click", () => this.toggle(k, button));
    offer.button = button;
    return button;
  }

  toggle(k, button) {
    const at = this.picked.findIndex((view) => view.offer === k);
    if (at >= 0) this.picked.splice(at, 1)[0].element.remove();
    else this.picked.push(new Clicked($("clicked"), this.offers[k], k, () => this.changed()));
    button.ariaPressed = String(at < 0);
    this.changed();
  }

  changed() {
    this.problem = "";
    this.picked.forEach((view, index) => {
      view.colour(index);
      this.offers[view.offer].button.style.setProperty("--tint", `var(--view-${index % 4})`);
    });
    this.say();
    this.picked.find((view) => view.points.length < CORNERS)?.element.scrollIntoView({ block: "nearest" });
  }

  // What is to be done next, in the line that is read first.
  say() {
    const open = this.picked.find((view) => view.points.length < CORNERS);
    const isReady = this.picked.length >= 2 && !open && !this.isBusy;
    let words = "ready: save and begin";
    let detail = "drag a corner to move it, or use the arrow keys on it";
    if (!this.offers.some((offer) => !offer.problem)) {
      words = "no camera and no recording here";
      detail = "plug cameras in, or start fingerpost live in the folder of the recordings";
    } else if (this.isBusy) words = "beginning";
    else if (open) {
      words = `click corner ${open.points.length + 1} in ${open.name}`;
      detail = "the four corners of a sheet or a mat on the table, around it, the same corner first in every view";
    } else if (this.picked.length < 2) {
      words = this.picked.length ? "pick one more view" : "pick two views, or more";
      detail = "they see the same table and the pointing hand from different sides";
    }
    $("begin").disabled = !isReady;
    $("point").hidden = true;
    $("words").hidden = false;
    setText($("words"), this.problem ? "that cannot be" : words);
    setText($("detail"), this.problem || detail);
    $("detail").title = this.problem || detail;
    const status = this.problem ? "lost" : isReady ? "ok" : "waiting";
    document.documentElement.dataset.status = status;
    $("badge-mark").setAttribute("href", `#mark-${status}`);
    setText($("badge-word"), this.problem ? "no" : isReady ? "ready" : "set-up");
  }

  begin() {
    const [width, height, unit] = $("sheet").value
      ? $("sheet").value.split(",").map((part, k) => (k < 2 ? Number(part) : part))
      : [Number($("width").value), Number($("height").value), $("plane-unit").value];
    const views = this.picked.map((view) => ({ offer: view.offer, points_px: view.points }));
    this.send({ do: "setup", width, height, unit, views });
  }

  hide() {
    $("setup").hidden = true;
  }
}

// A picked view: its picture, its corners, and a magnifier while one of them is placed.
class Clicked {
  constructor(parent, offer, k, changed) {
    this.offer = k;
    this.name = offer.name;
    this.size = offer.size;
    this.points = [];
    this.changed = changed;
    this.element = html("section", "click", parent);
    const head = html("header", "", this.element);
    this.swatch = html("i", "swatch", head);
    html("h2", "", head, offer.name);
    this.left = html("span", "left", head);
    const body = html("div", "body", this.element);
    this.svg = make("svg", { viewBox: `-0.5 -0.5 ${this.size[0]} ${this.size[1]}`, role: "group", "aria-label": `Corners in ${offer.name}` });
    body.append(this.svg);
    make("image", { href: `still/${k}.jpg`, x: -0.5, y: -0.5, width: this.size[0], height: this.size[1], preserveAspectRatio: "none" }, this.svg);
    this.image = new Image();
    this.image.src = `still/${k}.jpg`;
    this.quad = make("path", { class: "quad" }, this.svg);
    this.handles = [];
    this.listen();
    new ResizeObserver(() => this.draw()).observe(this.svg);
    this.draw();
  }

  colour(index) {
    this.swatch.style.background = `var(--view-${index % 4})`;
  }

  listen() {
    this.svg.addEventListener("pointerdown", (event) => {
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

  // Pixels of the view under the pointer.
  at(event) {
    const point = new DOMPoint(event.clientX, event.clientY).matrixTransform(this.svg.getScreenCTM().inverse());
    return [point.x, point.y].map((value, axis) => Math.min(Math.max(Math.round(10 * value) / 10, -0.5), this.size[axis] - 0.5));
  }

  move(event, isGrab = false) {
    if (!isGrab) this.points[this.dragged] = this.at(event);
    this.draw();
    this.magnify(event);
  }

  magnify(event) {
    const loupe = $("loupe");
    const [u, v] = this.points[this.dragged];
    const scale = this.image.naturalWidth / this.size[0];
    const context = loupe.getContext("2d");
    const side = loupe.width / ZOOM;
    const from = [(u + 0.5) * scale - side / 2, (v + 0.5) * scale - side / 2];
    context.fillStyle = "#11161c";
    context.fillRect(0, 0, loupe.width, loupe.height);
    context.drawImage(this.image, from[0], from[1], side, side, 0, 0, loupe.width, loupe.height);
    const middle = loupe.width / 2;
    for (const [width, colour] of [[4, "#11161c"], [1.5, "#ecf0f3"]]) {
      context.lineWidth = width;
      context.strokeStyle = colour;
      context.stroke(new Path2D(`M${middle} 10V${middle - 8}M${middle} ${middle + 8}V${2 * middle - 10}M10 ${middle}H${middle - 8}M${middle + 8} ${middle}H${2 * middle - 10}`));
    }
    loupe.hidden = false;
    const left = Math.min(Math.max(event.clientX - middle, 4), innerWidth - loupe.width - 4);
    const above = event.clientY - loupe.height - LOUPE_GAP_PX;
    Object.assign(loupe.style, { left: `${left}px`, top: `${above > 4 ? above : event.clientY + LOUPE_GAP_PX}px` });
  }

  handle(k) {
    const group = make("g", { class: "handle numbered", tabindex: 0, role: "button", "aria-label": `Corner ${k + 1} in ${this.name}; arrow keys move it` }, this.svg);
    make("circle", { class: "grip", r: GRIP_PX }, group);
    make("circle", { class: "mark-case", r: 6 }, group);
    make("circle", { class: "mark", r: 6 }, group);
    const label = make("g", {}, group);
    make("circle", { r: 9.5, class: "disc" }, label);
    make("text", { "text-anchor": "middle", dy: "0.36em" }, label).textContent = k + 1;
    group.addEventListener("keydown", (event) => {
      const by = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
      if (!by) return;
      event.preventDefault();
      const far = event.shiftKey ? 10 : 1;
      this.points[k] = this.points[k].map((value, axis) => Math.min(Math.max(value + far * by[axis], -0.5), this.size[axis] - 0.5));
      this.draw();
      this.changed();
    });
    return { group, label };
  }

  draw() {
    const scale = this.size[0] / Math.max(Math.min(this.svg.clientWidth, (this.svg.clientHeight * this.size[0]) / this.size[1]), 1);
    while (this.handles.length < this.points.length) this.handles.push(this.handle(this.handles.length));
    const middle = middleOf(this.points);
    this.points.forEach((point, k) => {
      place(this.handles[k].group, point, scale);
      this.handles[k].label.setAttribute("transform", `translate(${awayFrom(middle, point, 19)})`);
    });
    this.quad.setAttribute("d", this.points.length > 1 ? path([this.points.flat()], null, this.points.length === CORNERS) : "");
    setText(this.left, this.points.length < CORNERS ? `${this.points.length} of ${CORNERS} corners` : "all corners");
  }
}
