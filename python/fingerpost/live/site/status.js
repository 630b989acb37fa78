// The status line, and the figures beside it.

const SHOWN_EVERY_MS = 100;
const RATE_OVER_MS = 2000;
const SPOKEN_EVERY_MS = 2500;
const LONG_NUMBER = 6;
const WORDS = { ok: "ok", acquiring: "acquiring", lost: "lost", ill_conditioned: "in doubt" };

const $ = (id) => document.getElementById(id);

export class StatusLine {
  constructor() {
    this.shownAt = 0;
    this.spokenAt = 0;
    this.numbers = [];
    this.isPlaying = true;
  }

  open(rig) {
    $("unit").textContent = rig.unit;
    for (const sigma of document.querySelectorAll(".sigma")) sigma.dataset.unit = rig.unit;
    // As wide as the widest number on the plane, 20 % of its extent included on either side.
    const values = rig.points.flat();
    const [least, most] = [Math.min(...values), Math.max(...values)];
    const beyond = [least - 0.2 * (most - least), most + 0.2 * (most - least)];
    const widest = Math.max(...beyond.map((value) => value.toFixed(rig.digits).length));
    document.documentElement.style.setProperty("--number", `${widest}ch`);
    document.documentElement.style.setProperty("--sigma", `${widest - 1}ch`);
    document.documentElement.classList.toggle("long-numbers", widest > LONG_NUMBER);
    this.numbers = [];
  }

  show(scene) {
    const now = performance.now();
    this.count(scene.number, now);
    this.next = scene;
    const wait = this.isPlaying ? this.shownAt + SHOWN_EVERY_MS - now : 0;
    if (wait <= 0) this.put();
    else this.timer ??= setTimeout(() => this.put(), wait);
  }

  put() {
    clearTimeout(this.timer);
    this.timer = null;
    this.shownAt = performance.now();
    this.showStatus();
    if (this.halted || !this.next) return;
    const { head } = this.next;
    $("point").hidden = !head.point;
    $("words").hidden = Boolean(head.point);
    if (head.point) ["x", "y", "sx", "sy"].forEach((id, k) => setText($(id), head.point[k].replace("-", "−")));
    else setText($("words"), head.said);
    setText($("detail"), head.detail || "\u00a0");
    $("detail").title = head.detail;
    this.speak(head);
    setText($("rate"), this.rate());
  }

  // Stopped cameras have no known state; a paused recording shows a known moment.
  stand(isStopped) {
    if (this.isStopped === isStopped) return;
    this.isStopped = isStopped;
    this.showStatus();
  }

  // Shows why there is no present moment, in place of the last point; null: there is one.
  halt(why) {
    if (this.halted?.words === why?.words) return;
    this.halted = why;
    if (!why) return this.put();
    this.showStatus();
    $("point").hidden = true;
    $("words").hidden = false;
    setText($("words"), why.words);
    setText($("detail"), why.detail || "\u00a0");
    $("detail").title = why.detail;
    setText($("rate"), "–");
    setText($("latency"), "–");
    setText($("spoken"), why.words);
  }

  showStatus() {
    if (this.halted) return this.setStatus("lost", this.halted.badge);
    const status = this.next?.head.status ?? "waiting";
    if (this.isStopped) this.setStatus("stopped", "stopped");
    else this.setStatus(status, WORDS[status] ?? status);
  }

  setStatus(status, word) {
    document.documentElement.dataset.status = status;
    $("badge-mark").setAttribute("href", `#mark-${status}`);
    setText($("badge-word"), word);
  }

  latency(ms) {
    setText($("latency"), ms === null || this.halted ? "–" : ms.toFixed(0));
  }

  count(number, now) {
    const last = this.numbers.at(-1);
    if (last && number < last[0]) this.numbers = [];
    this.numbers.push([number, now]);
    while (now - this.numbers[0][1] > RATE_OVER_MS) this.numbers.shift();
  }

  rate() {
    const [first, last] = [this.numbers[0], this.numbers.at(-1)];
    if (!this.isPlaying || !first || last[1] - first[1] < RATE_OVER_MS / 8) return "–";
    return ((1000 * (last[0] - first[0])) / (last[1] - first[1])).toFixed(1);
  }

  // Changes of status are announced to screen readers; numbers change too often.
  speak(head) {
    const words = head.point ? "ok: there is a point" : head.said;
    const now = performance.now();
    if (words === this.spoken || now - this.spokenAt < SPOKEN_EVERY_MS) return;
    [this.spoken, this.spokenAt] = [words, now];
    $("spoken").textContent = words;
  }
}

export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}
