// The plan during set-up: expected errors on the plane, and places to point at.

import { html, make, path, place } from "./draw.js";
import { PlanPanel } from "./plan.js";

const RAMP = ["#2b6a8e", "#3fa89c", "#c4c85e", "#f09e3c", "#d8554a"];
const OCTAVES = 2; // on either side of the median error
const RING_PX = 22;
const CELL_TEXT_SHARE = 0.42; // of a cell's side: three digits fit
const LARGEST_TEXT_PX = 15;

export class SetUpPlan {
  constructor(parent) {
    this.parent = parent;
    new ResizeObserver(() => this.layOut()).observe(parent);
  }

  // scene: as on the live page; advice: the map of errors; aim: places and indicated points
  show(scene, advice, aim) {
    const known = JSON.stringify(scene);
    if (known !== this.known) {
      this.known = known;
      this.parent.replaceChildren();
      this.panel = scene ? new ErrorMap(this.parent, scene) : null;
      this.layOut();
    }
    if (!this.panel) return;
    this.panel.word.textContent = aim ? "" : advice ? `95 % of errors, ${advice.unit}` : "";
    this.panel.showErrors(aim ? null : advice);
    this.panel.showAim(aim);
  }

  layOut() {
    const { clientWidth: width, clientHeight: height } = this.parent;
    if (this.panel && width && height) this.panel.put({ left: 0, top: 0, width, height }, 1);
  }
}

class ErrorMap extends PlanPanel {
  constructor(stage, scene) {
    super(stage, scene);
    this.cells = make("g", { class: "cells" });
    this.grid.after(this.cells);
    this.aims = make("g", { class: "aims" }, this.window);
    this.errors = this.aim = null;
    place(this.point, null);
  }

  resize() {
    super.resize();
    if (!this.map) return;
    this.drawErrors();
    this.drawAim();
  }

  showErrors(advice) {
    if (this.errors === advice) return;
    this.errors = advice;
    if (this.map) this.drawErrors();
  }

  drawErrors() {
    this.cells.replaceChildren();
    const known = (this.errors?.cells ?? []).map(([, , error]) => error).filter((error) => error !== null);
    const usual = known.sort((a, b) => a - b)[known.length >> 1];
    const size = Math.min(CELL_TEXT_SHARE * 2 * (this.errors?.half ?? 0) * this.pxPerUnit, LARGEST_TEXT_PX);
    this.cells.style.fontSize = `${size}px`;
    for (const [x, y, error] of this.errors?.cells ?? []) {
      const half = 0.97 * this.errors.half;
      const square = [x - half, y - half, x + half, y - half, x + half, y + half, x - half, y + half];
      const share = error === null ? 1 : Math.min(Math.max(0.5 + Math.log2(error / usual) / (2 * OCTAVES), 0), 1);
      const colour = mixed(share);
      make("path", { d: path([square], this.map, true) }, this.cells).style.fill = `rgb(${colour})`;
      const [u, v] = this.map(x, y);
      const words = make("text", { x: u, y: v, dy: "0.36em", "text-anchor": "middle", fill: luminance(colour) > 0.25 ? "#11161c" : "#fff" }, this.cells);
      words.textContent = error === null ? "–" : error < 100 ? error.toPrecision(2) : Math.round(error);
    }
  }

  showAim(aim) {
    this.aim = aim;
    if (this.map) this.drawAim();
  }

  drawAim() {
    this.aims.replaceChildren();
    const { places = [], visits = [], share = 0, point, running } = this.aim ?? {};
    places.forEach((target, k) => {
      const [x, y] = this.map(...target);
      const state = k < visits.length ? "done" : k === visits.length && running ? "now" : "later";
      const group = make("g", { class: `aim ${state}`, transform: `translate(${x} ${y})` }, this.aims);
      make("circle", { r: RING_PX, class: "aim-disc" }, group);
      if (state === "now") make("circle", { r: RING_PX, class: "aim-ring", pathLength: 1, "stroke-dasharray": `${share} 1`, transform: "rotate(-90)" }, group);
      make("text", { "text-anchor": "middle", dy: "0.36em" }, group).textContent = k + 1;
      if (k >= visits.length) return;
      const [u, v] = this.map(...visits[k]);
      make("path", { class: "aim-off", d: `M${x} ${y}L${u} ${v}` }, this.aims);
      make("circle", { class: "aim-hit", cx: u, cy: v, r: 5 }, this.aims);
    });
    if (!point) return;
    const [cx, cy] = this.map(...point);
    make("circle", { class: "aim-point", cx, cy, r: 7 }, this.aims);
  }
}

// The expected errors in words.
export function errorsWords({ median, most, unit }, half = "half of the errors") {
  return most === null
    ? "no pose of the hand will have a point"
    : `${half} below ${median}\u00a0${unit}, 95\u00a0% below ${most}\u00a0${unit}`;
}

// Legend of the colours of errors.
export function legend(parent, advice) {
  parent.replaceChildren();
  if (!advice) return;
  const bar = html("i", "ramp", parent);
  bar.setAttribute("aria-hidden", "true");
  html("span", "", parent, errorsWords(advice));
}

function mixed(share) {
  const place = share * (RAMP.length - 1);
  const below = Math.min(Math.floor(place), RAMP.length - 2);
  const [a, b] = [RAMP[below], RAMP[below + 1]].map((hex) => [1, 3, 5].map((k) => parseInt(hex.slice(k, k + 2), 16)));
  return a.map((value, k) => Math.round(value + (place - below) * (b[k] - value)));
}

function luminance(colour) {
  const [r, g, b] = colour.map((value) => ((value / 255 + 0.055) / 1.055) ** 2.4);
  return 0.2126 * r + 0.7152 * g + 0.0722 * b;
}
