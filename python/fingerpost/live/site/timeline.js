// Status over time, with a row for each view, one for the point and one for its uncertainty; cursor
// and bookmarks of a recording.

import { html } from "./draw.js";

const HEIGHTS = { o: 1, a: 0.62, i: 0.62, m: 0.62, l: 0.3 };
const SEVERITY = "oaiml";
const LIVE_MOMENTS = 3600;
const ROW_GAP_PX = 2;

export class Timeline {
  constructor(canvas, cursor) {
    this.canvas = canvas;
    this.cursor = cursor;
    this.rows = [];
    this.first = 0;
    this.shown = -1;
    this.total = 0;
    new ResizeObserver(() => this.draw()).observe(canvas);
  }

  open(rig) {
    this.isLive = rig.live;
    this.rows = Array.from({ length: rig.views.length + 2 }, () => "");
    this.first = 0;
    this.shown = -1;
  }

  // The cursor moves with the picture (`move`), never ahead of it.
  take({ strip, total }) {
    const before = [this.rows[0]?.length, this.total].join();
    if (strip.rows.length) {
      const kept = strip.from - this.first;
      this.rows = this.rows.map((row, k) => row.slice(0, kept) + strip.rows[k]);
      const over = this.isLive ? this.rows[0].length - LIVE_MOMENTS : 0;
      if (over > 0) {
        this.rows = this.rows.map((row) => row.slice(over));
        this.first += over;
      }
    }
    this.total = total;
    if (before !== [this.rows[0]?.length, this.total].join()) this.draw();
  }

  get span() {
    return this.isLive ? LIVE_MOMENTS : Math.max(this.total, 1);
  }

  move(shown) {
    this.shown = shown;
    this.putCursor();
  }

  putCursor() {
    const width = this.canvas.clientWidth;
    this.cursor.hidden = this.isLive || this.shown < 0;
    this.cursor.style.transform = `translateX(${((this.shown + 0.5) / this.span) * width}px)`;
  }

  draw() {
    const scale = window.devicePixelRatio || 1;
    const [width, height] = [this.canvas.clientWidth * scale, this.canvas.clientHeight * scale].map(Math.round);
    if (!width || !height) return;
    if (this.canvas.width !== width || this.canvas.height !== height) [this.canvas.width, this.canvas.height] = [width, height];
    const context = this.canvas.getContext("2d");
    context.clearRect(0, 0, width, height);
    const style = getComputedStyle(document.documentElement);
    const colours = Object.fromEntries([...SEVERITY].map((code) => [code, style.getPropertyValue(`--code-${code}`)]));
    const each = (height - ROW_GAP_PX * scale * (this.rows.length - 1)) / this.rows.length;
    // The point's row is the first of the strip and is drawn below those of the views.
    const uncertainty = this.rows.at(-1) ?? "";
    [...this.rows.slice(1, -1), this.rows[0] ?? ""].forEach((row, k) => {
      this.drawRow(context, row, width, k * (each + ROW_GAP_PX * scale), (codes) => {
        const code = SEVERITY[Math.max(...codes.map((code) => SEVERITY.indexOf(code)))];
        return [colours[code], HEIGHTS[code] * each, each];
      });
    });
    const colour = style.getPropertyValue("--point");
    this.drawRow(context, uncertainty, width, (this.rows.length - 1) * (each + ROW_GAP_PX * scale), (codes) => {
      const most = Math.max(...codes.map((code) => (code === "-" ? -1 : Number(code))));
      return [colour, ((most + 1) / 10) * each, each];
    });
    this.putCursor();
  }

  // A column shows the worst of its moments; `styleOf` returns colour, height and row height.
  drawRow(context, row, width, top, styleOf) {
    const offset = this.isLive ? this.span - row.length : 0;
    const perColumn = this.span / width;
    let column = Math.floor(offset / perColumn);
    while (column < width) {
      const from = Math.max(Math.floor(column * perColumn) - offset, 0);
      const to = Math.max(Math.ceil((column + 1) * perColumn) - offset, from + 1);
      if (from >= row.length) break;
      const [colour, tall, height] = styleOf([...row.slice(from, to)]);
      context.fillStyle = colour;
      context.fillRect(column, top + height - tall, 1, tall);
      column += 1;
    }
  }

  // Indices of the views that had lost the finger at a moment.
  lostAt(number) {
    return this.rows.slice(1, -1).flatMap((row, k) => (row[number - this.first] === "l" ? [k] : []));
  }
}

// Bookmarked frames of a recording, stored in the browser by the recording's title.
export class Bookmarks {
  constructor(line, seek) {
    this.line = line;
    this.seek = seek;
    this.numbers = [];
    this.marks = [];
  }

  open(rig) {
    this.key = rig.live ? null : `bookmarks ${rig.title}`;
    this.numbers = this.key ? JSON.parse(localStorage.getItem(this.key) ?? "[]") : [];
    this.draw();
  }

  toggle(number) {
    if (!this.key || number < 0) return;
    this.numbers = this.numbers.includes(number) ? this.numbers.filter((each) => each !== number) : [...this.numbers, number].sort((a, b) => a - b);
    localStorage.setItem(this.key, JSON.stringify(this.numbers));
    this.draw();
  }

  // Goes to the next bookmark in a direction from a frame.
  go(from, direction) {
    const ahead = this.numbers.filter((number) => (number - from) * direction > 0);
    if (ahead.length) this.seek(direction > 0 ? ahead[0] : ahead.at(-1));
  }

  setTotal(total) {
    if (this.total === total) return;
    this.total = total;
    this.draw();
  }

  draw() {
    for (const mark of this.marks) mark.remove();
    this.marks = this.numbers.map((number) => {
      const mark = html("button", "bookmark", this.line);
      mark.type = "button";
      mark.setAttribute("aria-label", `Bookmark: frame ${number}`);
      mark.title = `frame ${number}`;
      mark.style.left = `${(100 * (number + 0.5)) / Math.max(this.total ?? 1, 1)}%`;
      mark.addEventListener("click", () => this.seek(number));
      return mark;
    });
  }
}
