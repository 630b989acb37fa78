// Base of views and plan: a title, a status at its right, a body.

import { html, make } from "./draw.js";

const WORDS = { ill_conditioned: "in doubt" };

export class Panel {
  constructor(stage, { className, title, index = null }) {
    this.element = html("section", `panel ${className}`, stage);
    this.element.setAttribute("aria-label", title);
    const head = html("header", "", this.element);
    if (index !== null) {
      const swatch = html("i", "swatch", head);
      swatch.style.background = `var(--view-${index % 4})`;
    }
    html("h2", "", head, title);
    this.state = html("span", "state", head);
    this.mark = make("svg", { viewBox: "0 0 24 24", "aria-hidden": "true" });
    this.use = make("use", {}, this.mark);
    this.word = html("span", "", null);
    this.state.append(this.mark, this.word);
    this.body = html("div", "body", this.element);
    this.emphasis = 1;
    this.scale = 1;
    this.showsEdges = false;
  }

  setStatus(status, word) {
    const key = status === "tracking" ? "ok" : status === "moved" ? "ill_conditioned" : status;
    if (this.status === status) return;
    this.status = status;
    this.state.dataset.status = key;
    this.use.setAttribute("href", `#mark-${key}`);
    this.word.textContent = WORDS[word] ?? word;
  }

  // Moves the panel to a rectangle of the stage.
  put({ left, top, width, height }, emphasis) {
    Object.assign(this.element.style, { left: `${left}px`, top: `${top}px`, width: `${width}px`, height: `${height}px` });
    this.emphasis = emphasis;
    this.resize();
  }
}
