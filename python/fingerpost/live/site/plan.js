// The plan of the working plane, to scale: constraint lines, indicated point, ellipse, trail.

import { awayFrom, dots, make, middleOf, numbered, path, place, pointMark, shortened, textWidth } from "./draw.js";
import { Panel } from "./panel.js";

const BORDER = 0.09;
const TICKS = 5;
const TICK_PX = 54;
const MARGIN = { left: 58, right: 16, top: 20, bottom: 46 };
const AGES = 4;
const ARROW_PX = 18;
const LABEL_ROOM_PX = 27;
const NAME_LINE = 1.35; // height of a line of text, relative to its size

export class PlanPanel extends Panel {
  constructor(stage, rig) {
    super(stage, { className: "plan", title: "working plane" });
    this.rig = rig;
    this.svg = make("svg", { role: "img", "aria-label": "Plan of the working plane" });
    this.body.append(this.svg);
    this.axes = make("g", { class: "axes" }, this.svg);
    this.window = make("svg", { class: "window" }, this.svg);
    this.plane = make("path", { class: "plane" }, this.window);
    this.grid = make("path", { class: "grid" }, this.window);
    this.outline = make("path", { class: "plan-outline" }, this.window);
    this.targets = rig.targets.map(() => make("path", { class: "target" }, this.window));
    this.numbers = rig.points.map((_, k) => numbered(this.window, k + 1));
    this.under = make("g", {}, this.window);
    this.bands = this.perView("band", "fill");
    this.lines = this.perView("constraint", "stroke");
    this.trail = Array.from({ length: AGES }, (_, k) => make("path", { class: `trail age-${k}` }, this.window));
    this.names = rig.targets.map(() => make("text", { class: "target-name", "text-anchor": "middle" }, this.window));
    this.ellipse = make("path", { class: "ellipse" }, this.window);
    this.point = pointMark(this.window);
    this.arrow = make("path", { class: "arrow" }, this.window);
    // Further layers, whose draw() is called when the plan or its moment changes.
    this.layers = [];
  }

  perView(className, property) {
    return this.rig.views.map((_, k) => {
      const shape = make("path", { class: className }, this.window);
      shape.style[property] = `var(--view-${k % 4})`;
      return shape;
    });
  }

  // Aspect ratio of the extent of the reference points on the plan.
  get aspect() {
    const [width, height] = this.extent();
    return width / height;
  }

  extent() {
    const placed = this.rig.points.map(([x, y]) => this.turned(x, y));
    const [us, vs] = [placed.map((p) => p[0]), placed.map((p) => p[1])];
    this.middle = [(Math.min(...us) + Math.max(...us)) / 2, (Math.min(...vs) + Math.max(...vs)) / 2];
    return [Math.max(...us) - Math.min(...us), Math.max(...vs) - Math.min(...vs)];
  }

  turned(x, y) {
    const [[a, b], [c, d]] = this.rig.turn;
    return [a * x + b * y, c * x + d * y];
  }

  resize() {
    const [width, height] = [this.body.clientWidth, this.body.clientHeight];
    if (!width || !height) return;
    const margin = this.margin = Object.fromEntries(Object.entries(MARGIN).map(([side, px]) => [side, px * Math.min(this.emphasis, 1.5)]));
    this.inner = [width - margin.left - margin.right, height - margin.top - margin.bottom];
    const extent = this.extent();
    // Margin for the numbers of the reference points and for points slightly beyond them.
    const room = this.inner.map((side) => Math.max(Math.min(side / (1 + 2 * BORDER), side - 2 * LABEL_ROOM_PX * this.emphasis), side / 4));
    this.pxPerUnit = Math.min(room[0] / extent[0], room[1] / extent[1]);
    this.map = (x, y) => {
      const [u, v] = this.turned(x, y);
      return [
        this.inner[0] / 2 + this.pxPerUnit * (u - this.middle[0]),
        this.inner[1] / 2 + this.pxPerUnit * (v - this.middle[1]),
      ];
    };
    this.svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
    for (const [name, value] of Object.entries({ x: margin.left, y: margin.top, width: this.inner[0], height: this.inner[1] })) {
      this.window.setAttribute(name, value);
    }
    this.drawPlane(margin);
    if (this.last) this.draw(this.last);
    else this.drawLayers();
  }

  drawLayers() {
    for (const layer of this.layers) layer.draw();
  }

  drawPlane(margin) {
    const around = [this.rig.hull.flatMap((k) => this.rig.points[k])];
    this.plane.setAttribute("d", path(around, this.map, true));
    this.outline.setAttribute("d", path(around, this.map, true));
    const places = this.rig.points.map(([x, y]) => this.map(x, y));
    const middle = middleOf(places);
    this.numbers.forEach(({ group, label }, k) => {
      place(group, places[k], this.emphasis);
      label.setAttribute("transform", `translate(${awayFrom(middle, places[k], 17)})`);
    });
    this.drawTargets();
    this.drawAxes(margin);
  }

  // A target is the set of points within its radius of a polygon: a filled shape with a wide stroke
  // and round corners. For a single point it is a disc.
  drawTargets() {
    this.rig.targets.forEach(({ corners, radius }, k) => {
      const shape = corners.length > 1 ? path([corners.flat()], this.map, true) : dots(corners.flat(), this.map);
      this.targets[k].setAttribute("d", shape);
      this.targets[k].style.strokeWidth = `${2 * radius * this.pxPerUnit}px`;
    });
    const size = (this.nameSize = 13 * Math.min(this.emphasis, 1.5));
    this.middles = this.rig.targets.map(({ corners }) => middleOf(corners.map(([x, y]) => this.map(x, y))));
    this.middles.forEach(([, y], k) => this.names[k].setAttribute("y", y + 0.36 * size));
    // A name ends before that of the next target beside it.
    this.rooms = this.middles.map(([x], k) => {
      const beside = this.middles.filter((_, j) => j !== k && this.isBeside(j, k));
      return Math.min(...beside.map((other) => Math.abs(other[0] - x))) - 0.5 * size;
    });
  }

  // Whether the names of two targets are on one line.
  isBeside(j, k) {
    return Math.abs(this.middles[j][1] - this.middles[k][1]) < NAME_LINE * this.nameSize;
  }

  // The name of a likely target is whole; others are shortened if there is no room.
  drawName(k, share, isLikely) {
    const [element, { name }] = [this.names[k], this.rig.targets[k]];
    const percent = Math.round(100 * share);
    element.classList.toggle("likely", isLikely);
    let words = this.last.targets ? `${name} ${percent} %` : name;
    if (!isLikely && textWidth(words, element) > this.rooms[k]) {
      const tail = percent ? ` ${percent} %` : "";
      words = shortened(name, this.rooms[k] - textWidth(tail, element), element) + tail;
    }
    if (element.textContent !== words) element.textContent = words;
    const half = 0.5 * textWidth(words, element);
    const x = Math.max(Math.min(this.middles[k][0], this.inner[0] - half), half);
    element.setAttribute("x", x);
    return { x, half };
  }

  // Names that a likely target's would cover are not shown.
  drawNames(shares, likely) {
    const drawn = this.names.map((_, k) => this.drawName(k, shares?.[k] ?? 0, likely[k]));
    drawn.forEach(({ x, half }, k) => {
      const isCovered = drawn.some((other, j) => likely[j] && j !== k && this.isBeside(j, k) && Math.abs(other.x - x) < other.half + half);
      this.names[k].style.visibility = isCovered && !likely[k] ? "hidden" : "";
    });
  }

  drawAxes(margin) {
    this.axes.replaceChildren();
    const across = this.rig.turn[0][0] ? 0 : 1;
    const [width, height] = this.inner;
    const size = 13 * Math.min(this.emphasis, 1.5);
    let grid = "";
    for (const [value, at] of this.ticks(across, 0, width)) {
      grid += `M${at} 0V${height}`;
      this.label(value, margin.left + at, margin.top + height + 1.5 * size, "middle");
    }
    for (const [value, at] of this.ticks(1 - across, 1, height)) {
      grid += `M0 ${at}H${width}`;
      this.label(value, margin.left - 0.6 * size, margin.top + at + 0.36 * size, "end");
    }
    this.grid.setAttribute("d", grid);
    this.label(`${"XY"[across]} / ${this.rig.unit}`, margin.left + width, margin.top + height + 2.9 * size, "end");
    this.label(`${"YX"[across]} / ${this.rig.unit}`, 0.6 * size, margin.top - 0.4 * size, "start");
  }

  label(words, x, y, anchor) {
    make("text", { x, y, "text-anchor": anchor }, this.axes).textContent = String(words).replace("-", "−");
  }

  // Round numbers along an axis of the plane, each with its position along the plan's edge [px].
  ticks(axis, row, length) {
    const sign = this.rig.turn[row][axis];
    const rough = Math.max(Math.min(...this.inner) / TICKS, TICK_PX * this.emphasis) / this.pxPerUnit;
    const power = 10 ** Math.floor(Math.log10(rough));
    const nice = [1, 2, 5, 10].map((k) => k * power);
    const step = nice.reduce((a, b) => (Math.abs(Math.log(b / rough)) < Math.abs(Math.log(a / rough)) ? b : a));
    const at = (value) => length / 2 + this.pxPerUnit * (sign * value - this.middle[row]);
    const value = (px) => ((px - length / 2) / this.pxPerUnit + this.middle[row]) * sign;
    const [low, high] = [value(0), value(length)].sort((a, b) => a - b);
    const found = [];
    for (let k = Math.ceil(low / step); k * step <= high; k++) found.push([parseFloat((k * step).toPrecision(12)), at(k * step)]);
    return found;
  }

  show(plan, status) {
    this.last = plan;
    const axes = plan.axes;
    this.word.textContent = axes ? `95 % ellipse ${axes[0]} × ${axes[1]} ${this.rig.unit}` : "";
    this.element.dataset.status = status;
    if (this.map) this.draw(plan);
  }

  draw(plan) {
    plan.lines.forEach((line, k) => {
      this.bands[k].setAttribute("d", line?.band ? path([line.band], this.map, true) : "");
      this.lines[k].setAttribute("d", line ? path([line.ends], this.map) : "");
    });
    const count = plan.trail.length / 2;
    this.trail.forEach((part, k) => {
      const [from, to] = [Math.round((k * count) / AGES), Math.round(((k + 1) * count) / AGES)];
      part.setAttribute("d", dots(plan.trail.slice(2 * from, 2 * to), this.map));
    });
    const best = Math.max(0.5, ...(plan.targets ?? []));
    const likely = this.rig.targets.map(({ rest }, k) => (plan.targets?.[k] ?? 0) >= best && !rest);
    this.targets.forEach((target, k) => {
      target.style.opacity = 0.16 + 0.5 * (plan.targets?.[k] ?? 0);
      target.classList.toggle("likely", likely[k]);
    });
    this.drawNames(plan.targets, likely);
    this.ellipse.setAttribute("d", plan.ellipse ? path([plan.ellipse], this.map, true) : "");
    const at = plan.point ? this.map(...plan.point) : null;
    place(this.point, at, this.emphasis);
    this.arrow.setAttribute("d", at ? this.pointer(at) : "");
    this.drawLayers();
  }

  // An arrow at the border towards a point outside the visible area.
  pointer(at) {
    const middle = this.inner.map((side) => side / 2);
    const away = [at[0] - middle[0], at[1] - middle[1]];
    const beyond = Math.max(Math.abs(away[0]) / middle[0], Math.abs(away[1]) / middle[1]);
    if (beyond <= 1) return "";
    const tip = away.map((part, k) => middle[k] + part / (beyond * 1.02));
    const along = away.map((part) => part / Math.hypot(...away));
    const back = tip.map((part, k) => part - ARROW_PX * along[k]);
    const across = [-along[1] * ARROW_PX * 0.5, along[0] * ARROW_PX * 0.5];
    return `M${tip}L${back[0] + across[0]} ${back[1] + across[1]}L${back[0] - across[0]} ${back[1] - across[1]}Z`;
  }
}
