// SVG elements and shapes; shapes are lists of polylines, each a flat x, y, x, y, ...

const SVG = "http://www.w3.org/2000/svg";

export function make(tag, attributes = {}, parent = null) {
  const element = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  if (parent) parent.append(element);
  return element;
}

export function html(tag, className, parent, text = "") {
  const element = document.createElement(tag);
  if (className) element.className = className;
  if (text) element.textContent = text;
  if (parent) parent.append(element);
  return element;
}

// The attribute `d` of a path through polylines; `map` transforms points to drawing coordinates.
export function path(polylines, map = null, closed = false) {
  let d = "";
  for (const line of polylines ?? []) {
    for (let i = 0; i + 1 < line.length; i += 2) {
      const [x, y] = map ? map(line[i], line[i + 1]) : [line[i], line[i + 1]];
      d += `${i ? "L" : "M"}${round(x)} ${round(y)}`;
    }
    if (closed && line.length) d += "Z";
  }
  return d;
}

// Line segments from a flat list, x, y, x, y for each.
export function segments(flat) {
  let d = "";
  for (let i = 0; i + 3 < flat.length; i += 4) {
    if (flat.slice(i, i + 4).includes(null)) continue;
    d += `M${flat[i]} ${flat[i + 1]}L${flat[i + 2]} ${flat[i + 3]}`;
  }
  return d;
}

// Dots, drawn as lines of length zero with round caps.
export function dots(flat, map = null) {
  let d = "";
  for (let i = 0; i + 1 < flat.length; i += 2) {
    const [x, y] = map ? map(flat[i], flat[i + 1]) : [flat[i], flat[i + 1]];
    d += `M${round(x)} ${round(y)}h0`;
  }
  return d;
}

export function crosses(flat, size) {
  let d = "";
  for (let i = 0; i + 1 < flat.length; i += 2) {
    const [x, y] = [flat[i], flat[i + 1]];
    d += `M${x - size} ${y - size}l${2 * size} ${2 * size}M${x - size} ${y + size}l${2 * size} ${-2 * size}`;
  }
  return d;
}

export function place(element, point, scale = 1) {
  element.toggleAttribute("hidden", !point);
  element.style.display = point ? "" : "none";
  if (point) element.setAttribute("transform", `translate(${round(point[0])} ${round(point[1])}) scale(${scale})`);
}

// The mark of the indicated point: dark ring, light ring, coloured core.
export function pointMark(parent) {
  const group = make("g", { class: "point-mark" }, parent);
  make("circle", { r: 7.5, class: "casing" }, group);
  make("circle", { r: 6, class: "ring" }, group);
  make("circle", { r: 4, class: "core" }, group);
  return group;
}

// A reference point with its number in a disc, offset away from the centroid of all points.
export function numbered(parent, number) {
  const group = make("g", { class: "numbered" }, parent);
  make("circle", { r: 3, class: "dot" }, group);
  const label = make("g", {}, group);
  make("circle", { r: 9.5, class: "disc" }, label);
  make("text", { "text-anchor": "middle", dy: "0.36em" }, label).textContent = number;
  return { group, label };
}

export function awayFrom(middle, point, length) {
  const [x, y] = [point[0] - middle[0], point[1] - middle[1]];
  const size = Math.max(Math.hypot(x, y), 1e-9);
  return [(x / size) * length, (y / size) * length];
}

export function middleOf(points) {
  const seen = points.filter(Boolean);
  const sum = seen.reduce(([x, y], p) => [x + p[0], y + p[1]], [0, 0]);
  return seen.length ? [sum[0] / seen.length, sum[1] / seen.length] : [0, 0];
}

const ruler = document.createElement("canvas").getContext("2d");

// Width of a text in the font of an element [px].
export function textWidth(words, element) {
  const { fontWeight, fontSize, fontFamily } = getComputedStyle(element); // `font` is empty with tabular figures
  ruler.font = `${fontWeight} ${fontSize} ${fontFamily}`;
  return ruler.measureText(words).width;
}

// The longest of the beginnings of a text that fits into a width; the last one if none does.
export function fitting(beginnings, width, element) {
  return beginnings.find((words) => textWidth(words, element) <= width) ?? beginnings.at(-1);
}

// A text without its middle, so that it fits into a width: names often differ at their end.
export function shortened(words, width, element) {
  const without = (kept) => `${words.slice(0, Math.ceil(kept / 2))}…${words.slice(words.length - Math.floor(kept / 2))}`;
  const shorter = Array.from({ length: Math.max(words.length - 2, 1) }, (_, k) => without(words.length - 2 - k));
  return fitting([words, ...shorter], width, element);
}

function round(value) {
  return Math.round(value * 100) / 100;
}
