// An experiment: targets in random order, the error of each, and summary statistics.

import { crosses, dots, html, make, path } from "./draw.js";
import { drawRing } from "./robot.js";
import { setText } from "./status.js";

export class Experiment {
  constructor(element, tools, send) {
    this.element = element;
    this.send = send;
    this.layer = new TargetsOnPlan();
    this.open = html("button", "", null);
    Object.assign(this.open, { type: "button", id: "experiment-open", title: "Experiment: point at targets (X)", ariaLabel: "Experiment" });
    this.open.setAttribute("aria-keyshortcuts", "X");
    const mark = make("svg", { viewBox: "0 0 24 24", "aria-hidden": "true" });
    make("path", { d: "M12 2v5M12 17v5M2 12h5M17 12h5", stroke: "currentColor", "stroke-width": 2, "stroke-linecap": "round" }, mark);
    make("circle", { cx: 12, cy: 12, r: 6, fill: "none", stroke: "currentColor", "stroke-width": 2 }, mark);
    this.open.append(mark);
    tools.prepend(this.open);
    this.build();
    this.listen();
  }

  build() {
    this.said = html("p", "doing", this.element);
    this.said.setAttribute("role", "status");
    this.last = html("p", "arm-detail", this.element);
    const row = html("div", "switches", this.element);
    this.buttons = {};
    for (const [what, words, key] of [["select", "Select", "⏎"], ["skip", "Skip", "K"], ["end", "End", "X"]]) {
      const each = html("button", "", row, words);
      each.type = "button";
      html("kbd", "", each, key).setAttribute("aria-hidden", "true");
      each.addEventListener("click", () => this.do(what));
      this.buttons[what] = each;
    }
    const label = html("label", "blind", row);
    this.blind = html("input", "", label);
    this.blind.type = "checkbox";
    label.append("hide the point");
    this.blind.addEventListener("change", () => this.hidePoint());
    this.table = html("pre", "figures", this.element);
  }

  listen() {
    this.open.addEventListener("click", () => this.toggle());
    addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey || event.repeat || !this.has) return;
      const onControl = event.target.closest?.("button, input, select, a, dialog");
      const key = event.key.toLowerCase();
      if (key === "x") this.toggle();
      else if (this.now && key === "enter" && !onControl) this.do("select");
      else if (this.now && key === "k") this.do("skip");
      else return;
      event.preventDefault();
    });
  }

  do(what) {
    this.send({ do: "experiment", what });
  }

  toggle() {
    this.do(this.now ? "end" : "start");
  }

  hidePoint() {
    document.documentElement.classList.toggle("blind-point", Boolean(this.now) && this.blind.checked && !this.now.over);
  }

  attach(plan, unit) {
    this.unit = unit;
    this.layer.attach(plan);
  }

  show(now, hasRig) {
    [this.now, this.has] = [now, hasRig];
    document.documentElement.classList.toggle("with-experiment", Boolean(now));
    this.element.hidden = !now;
    this.open.setAttribute("aria-pressed", Boolean(now));
    this.hidePoint();
    this.layer.show(now);
    if (!now) return;
    const count = now.done.length;
    setText(this.said, now.over ? `${count} of ${now.total} targets` : `Target ${count + 1} of ${now.total}: point at it and stay, or press Enter`);
    const last = now.done.at(-1);
    const error = last ? (last.error ? `the last one: ${last.error} ${this.unit} off` : "the last one: no point") : "";
    setText(this.last, now.over ? (now.file ? `saved in ${now.file}` : "nothing to save") : error);
    this.last.title = now.file;
    setText(this.table, now.lines.join("\n"));
    this.table.hidden = !now.lines.length;
    for (const what of ["select", "skip"]) this.buttons[what].hidden = now.over;
    setText(this.buttons.end.firstChild, now.over ? "Close" : "End");
    this.blind.parentElement.hidden = now.over;
  }
}

// The current target; errors and 95 % ellipses of the completed ones.
export class TargetsOnPlan {
  attach(plan) {
    this.plan = plan;
    const add = (name) => make("path", { class: name }, plan.under);
    this.shapes = Object.fromEntries(["trial-ellipse held", "trial-ellipse missed", "trial-error", "trial-done", "trial-skipped"].map((name) => [name, add(name)]));
    this.target = make("g", { class: "trial-target" }, plan.window);
    make("circle", { r: 17 }, this.target);
    make("path", { d: "M-26 0H-9M9 0H26M0 -26V-9M0 9V26" }, this.target);
    make("circle", { r: 3, class: "middle" }, this.target);
    this.ring = make("circle", { class: "dwell", r: 17, pathLength: 1 }, plan.window);
    plan.layers.push(this);
    this.draw();
  }

  show(now) {
    this.now = now;
    if (this.plan) this.draw();
  }

  draw() {
    const { now, plan, shapes } = this;
    const done = (plan.map && now?.done) || [];
    const found = done.filter((each) => each.point);
    const ellipses = (held) => path(found.filter((each) => each.held === held).map((each) => each.ellipse), plan.map, true);
    const put = (name, d) => shapes[name].setAttribute("d", d);
    put("trial-ellipse held", ellipses(true));
    put("trial-ellipse missed", ellipses(false));
    put("trial-error", path(found.map((each) => [...each.target, ...each.point]), plan.map));
    put("trial-done", dots(done.flatMap((each) => each.target), plan.map));
    put("trial-skipped", crosses(done.filter((each) => !each.point).flatMap((each) => plan.map(...each.target)), 7));
    const at = plan.map && now?.target ? plan.map(...now.target) : null;
    this.target.style.display = at ? "" : "none";
    if (at) this.target.setAttribute("transform", `translate(${at}) scale(${plan.emphasis})`);
    drawRing(this.ring, plan, at ? now.dwell : 0, at);
  }
}
