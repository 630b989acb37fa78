// One view: its picture, overlaid with all results of the same instant.

import { awayFrom, crosses, dots, fitting, html, make, middleOf, numbered, path, place, pointMark, segments } from "./draw.js";
import { Panel } from "./panel.js";

const LABEL_PX = 17;

export class ViewPanel extends Panel {
  constructor(stage, index, name, count) {
    super(stage, { className: "view", title: name, index });
    this.index = index;
    this.caption = html("p", "caption", this.element);
    this.canvas = html("canvas", "", this.body);
    this.canvas.setAttribute("role", "img");
    this.canvas.setAttribute("aria-label", `Picture of view ${name}`);
    this.context = this.canvas.getContext("2d");
    this.svg = make("svg", { "aria-hidden": "true", class: "overlay" });
    this.body.append(this.svg);
    this.empty = html("p", "empty", this.body, "no picture yet");
    this.addWhy(name);
    this.shapes(count);
  }

  // On click, shows the reasons for the frame's result, and draws the search.
  addWhy(name) {
    this.whyOpen = html("button", "why-open", null, "why");
    this.whyOpen.type = "button";
    this.whyOpen.setAttribute("aria-label", `Why ${name} sees what it sees`);
    this.whyOpen.setAttribute("aria-pressed", false);
    this.state.before(this.whyOpen);
    this.why = html("div", "why", this.body);
    this.why.hidden = true;
    this.whyWords = html("ul", "", this.why);
    html("p", "legend", this.why);
    for (const [className, words] of [["line", "searched"], ["edge", "chosen"], ["cross", "rejected"]]) {
      const each = html("span", `key-${className}`, this.why.lastChild, words);
      each.prepend(html("i", "", null));
    }
    this.whyOpen.addEventListener("click", () => this.explain(!this.explains));
    this.body.addEventListener("click", () => this.explain(!this.explains));
  }

  explain(explains) {
    this.explains = explains;
    this.why.hidden = !explains;
    this.whyOpen.setAttribute("aria-pressed", explains);
    if (this.last) this.draw(this.last);
  }

  drawWhy(seen) {
    const skew = seen.skew === undefined ? [] : [`${Math.abs(seen.skew).toFixed(1)} ms ${seen.skew < 0 ? "before" : "after"} the point`];
    const words = [...seen.reasons.flatMap((reason) => reason.split("   ")), ...skew].join("\n");
    if (this.whyWords.dataset.words === words) return;
    this.whyWords.dataset.words = words;
    this.whyWords.replaceChildren(...words.split("\n").map((line) => Object.assign(document.createElement("li"), { textContent: line })));
  }

  shapes(count) {
    const add = (name) => make("path", { class: name }, this.svg);
    this.outlineCase = add("outline case");
    this.outline = add("outline");
    this.references = [];
    this.others = Array.from({ length: count }, (_, k) => {
      const line = add("other");
      line.style.stroke = `var(--shown-${k % 4})`;
      return line;
    });
    this.contourCase = add("contour case");
    this.contour = add("contour");
    this.searchLines = add("search-lines edges");
    this.chosen = add("chosen edges");
    this.rejected = add("rejected edges");
    this.fingerCase = add("finger case");
    this.finger = add("finger");
    this.finger.style.stroke = `var(--shown-${this.index % 4})`;
    this.ellipse = add("ellipse");
    this.point = pointMark(this.svg);
  }

  resize() {
    const [width, height] = this.size ?? [4, 3];
    this.scale = width / Math.max(this.body.clientWidth, 1);
    this.svg.setAttribute("viewBox", `-0.5 -0.5 ${width} ${height}`);
    if (!this.last) return;
    this.draw(this.last);
    this.setCaption(this.last.reasons);
  }

  show(seen, picture) {
    this.setStatus(seen.status, seen.status === "ok" ? "tracking" : seen.status);
    this.setCaption(seen.reasons);
    this.element.classList.toggle("without", !picture);
    this.empty.textContent = seen.reasons[0] ?? "no picture";
    if (!picture) {
      this.last = null;
      return;
    }
    if (this.canvas.width !== picture.width || this.canvas.height !== picture.height) {
      [this.canvas.width, this.canvas.height] = [picture.width, picture.height];
    }
    this.context.drawImage(picture, 0, 0);
    this.last = seen;
    if (String(this.size) !== String(seen.size)) {
      this.size = seen.size;
      this.resize();
    } else this.draw(seen);
  }

  // All reasons if there is room, else the beginning of the first one; "why" shows all.
  setCaption(reasons) {
    const words = reasons.join("   ");
    const width = this.body.clientWidth;
    const known = `${width} ${words}`;
    if (this.captioned === known) return;
    this.captioned = known;
    const first = reasons[0] ?? "";
    this.caption.textContent = fitting([words, first, first.split(/ \(|, |; /)[0], first.split(":")[0]], width, this.caption);
    this.caption.title = words;
  }

  draw(seen) {
    const outline = path(seen.outline);
    this.outlineCase.setAttribute("d", outline);
    this.outline.setAttribute("d", outline);
    this.drawReferences(seen.references ?? []);
    this.others.forEach((line, k) => line.setAttribute("d", path(seen.others?.[k])));
    const contour = path(seen.contour);
    this.contourCase.setAttribute("d", contour);
    this.contour.setAttribute("d", contour);
    this.contour.setAttribute("class", `contour ${seen.status}`);
    const finger = path(seen.finger);
    this.fingerCase.setAttribute("d", finger);
    this.finger.setAttribute("d", finger);
    this.ellipse.setAttribute("d", path(seen.ellipse, null, true));
    place(this.point, seen.point, this.scale * this.emphasis);
    if (this.explains) this.drawWhy(seen);
    const search = this.showsEdges || this.explains ? seen.search : { lines: [], chosen: [], rejected: [] };
    this.searchLines.setAttribute("d", segments(search.lines));
    this.chosen.setAttribute("d", dots(search.chosen));
    this.rejected.setAttribute("d", crosses(search.rejected, 3 * this.scale));
  }

  // Offset of a number from its point: outwards, but inside the picture if the point is.
  beside(point, middle) {
    const px = this.scale * this.emphasis;
    return awayFrom(middle, point, LABEL_PX).map((away, axis) => {
      const last = this.size[axis] - 1;
      if (point[axis] < 0 || point[axis] > last) return away;
      const at = Math.min(Math.max(point[axis] + away * px, 11 * px), last - 11 * px);
      return (at - point[axis]) / px;
    });
  }

  drawReferences(points) {
    while (this.references.length < points.length) {
      const mark = numbered(this.svg, this.references.length + 1);
      this.svg.insertBefore(mark.group, this.others[0] ?? this.contourCase);
      this.references.push(mark);
    }
    const middle = middleOf(points);
    this.references.forEach(({ group, label }, k) => {
      place(group, points[k], this.scale * this.emphasis);
      if (points[k]) label.setAttribute("transform", `translate(${this.beside(points[k], middle)})`);
    });
  }
}
