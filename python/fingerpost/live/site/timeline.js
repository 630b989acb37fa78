// Status over time, a row for each view and one for the point, and the place in it.

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
    this.rows = Array.from({ length: rig.views.length + 1 }, () => "");
    this.first = 0;
    this.shown = -1;
  }

  // The cursor goes with the picture (`move`), never ahead of it.
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
    // The point's row is the first one of the strip, and stands below the views'.
    [...this.rows.slice(1), this.rows[0] ?? ""].forEach((row, k) => {
      this.drawRow(context, row, width, k * (each + ROW_GAP_PX * scale), each, colours);
    });
    this.putCursor();
  }

  // A column shows the worst of its moments; the lower a bar the worse, beside its colour.
  drawRow(context, row, width, top, height, colours) {
    const offset = this.isLive ? this.span - row.length : 0;
    const perColumn = this.span / width;
    let column = Math.floor(offset / perColumn);
    while (column < width) {
      const from = Math.max(Math.floor(column * perColumn) - offset, 0);
      const to = Math.max(Math.ceil((column + 1) * perColumn) - offset, from + 1);
      if (from >= row.length) break;
      const worst = Math.max(...[...row.slice(from, to)].map((code) => SEVERITY.indexOf(code)));
      const code = SEVERITY[worst];
      context.fillStyle = colours[code];
      const tall = HEIGHTS[code] * height;
      context.fillRect(column, top + height - tall, 1, tall);
      column += 1;
    }
  }
}
