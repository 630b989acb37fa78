// Set-up without typing, in five steps that can be visited in any order.

import { html } from "./draw.js";
import { errorsWords, legend, SetUpPlan } from "./setup_plan.js";
import { CORNERS, SetUpView } from "./setup_view.js";
import { setText } from "./status.js";

const STEPS = [
  ["views", "Views"],
  ["table", "Table"],
  ["hand", "Hand"],
  ["aim", "Aim"],
  ["save", "Save"],
];
const PLANES = {
  A4: "A4 sheet",
  A3: "A3 sheet",
  letter: "letter sheet",
  "credit-card": "bank card",
  markers: "marker sheet, A4",
  "markers:letter": "marker sheet, letter",
};
const OTHER = "other";
const SLIDER = { min: 20, max: 1500, step: 1 };
const REFUSED_FOR_MS = 6000;
const SLIDES_PAUSE_MS = 250;

const $ = (id) => document.getElementById(id);

export class SetUp {
  // send(command)
  constructor(send) {
    this.send = send;
    this.offers = [];
    this.picked = [];
    this.awaited = new Set(); // dropped recordings that are not offered yet
    this.number = Date.now(); // of arrangements; unlike those of other pages
    this.asked = null; // number of an arrangement whose result has not come
    this.isConnected = true;
    this.step = "views";
    this.refused = { words: "", until: 0 };
    this.plan = new SetUpPlan($("setup-plan"));
    this.steps = new Map(STEPS.map(([step, title], k) => [step, this.stepButton(step, title, k)]));
    this.buildAsks();
    $("setup").dataset.step = this.step;
    $("previous").addEventListener("click", () => this.go(-1));
    $("next").addEventListener("click", () => this.go(1));
    $("begin").addEventListener("click", () => this.send({ do: "begin" }));
    $("films").addEventListener("change", () => this.drop($("films").files));
    addEventListener("dragover", (event) => this.isOpen && event.preventDefault());
    addEventListener("drop", (event) => {
      if (!this.isOpen) return;
      event.preventDefault();
      this.drop(event.dataTransfer.files);
    });
  }

  get isOpen() {
    return !$("setup").hidden;
  }

  stepButton(step, title, k) {
    const button = html("button", "step", $("steps"));
    button.type = "button";
    button.setAttribute("aria-keyshortcuts", k + 1);
    html("i", "", button, k + 1);
    html("b", "", button, title);
    const found = html("small", "", button);
    button.addEventListener("click", () => this.choose(step));
    return { button, found };
  }

  // --- controls of the steps ------------------------------------------------------------------

  buildAsks() {
    const asks = $("asks");
    const button = (words, step, click) => {
      const made = html("button", "ask", asks, words);
      Object.assign(made, { type: "button", hidden: true });
      made.dataset.step = step;
      made.addEventListener("click", click);
      return made;
    };
    this.buildPlane(asks);
    this.again = button("Look again", "table", () => this.findAgain());
    this.byHand = button("Click corners myself", "table", () => this.clickMyself());
    this.look = button("Look for the hand", "hand", () => this.send({ do: this.isLooking ? "leave" : "hand" }));
    this.hold = button("Hold it up to a template", "hand", () => this.toggleTemplate());
    this.thumb = button("Thumb on the right", "hand", () => this.turnTemplates());
    this.learn = button("Begin", "aim", () => this.send({ do: this.isLooking ? "leave" : "aim" }));
    this.forget = button("Forget it", "aim", () => this.send({ do: "aim", learns: false }));
  }

  buildPlane(asks) {
    this.planeAsk = html("div", "ask-plane", asks);
    const label = html("label", "", this.planeAsk, "On the table lies ");
    this.select = html("select", "", label);
    for (const [value, words] of [...Object.entries(PLANES), [OTHER, "another rectangle"]]) html("option", "", this.select, words).value = value;
    this.select.addEventListener("change", () => this.changePlane());
    this.sliders = ["Side 1–2", "Side 2–3"].map((words) => {
      const row = html("div", "slide", this.planeAsk);
      html("span", "", row, words);
      const [slider, value] = ["range", "number"].map((type) => Object.assign(html("input", "", row), { type, ...SLIDER, ariaLabel: `${words}, mm` }));
      html("span", "", row, "mm");
      slider.addEventListener("input", () => this.slide((value.value = slider.value)));
      value.addEventListener("input", () => value.checkValidity() && this.slide((slider.value = value.value)));
      value.addEventListener("change", () => (value.value = slider.value));
      value.addEventListener("keydown", (event) => event.key === "Enter" && value.blur());
      return { row, slider, value };
    });
  }

  changePlane() {
    if (this.select.value === OTHER) return this.slide();
    this.plane = this.select.value;
    this.findAgain();
  }

  slide() {
    this.plane = this.sliders.map(({ slider }) => slider.value).join("x");
    this.showPlane(this.sliders.map(({ slider }) => Number(slider.value)));
    clearTimeout(this.slides);
    this.slides = setTimeout(() => this.findFound(), SLIDES_PAUSE_MS);
  }

  findAgain() {
    for (const view of this.picked) view.clear(false);
    this.arrange(true);
  }

  // Corners that were found for other sides may be those of another rectangle.
  findFound() {
    for (const view of this.picked) if (!view.isByHand) view.clear(false);
    this.arrange(this.open.length > 0);
  }

  clickMyself() {
    for (const view of this.picked) view.clear(true);
    this.changed();
  }

  toggleTemplate() {
    const isHeld = this.picked.some((view) => view.held);
    for (const view of this.picked) isHeld ? view.letGo() : view.hold(this.side ?? "left");
    this.arrange(false);
    this.say();
  }

  turnTemplates() {
    this.side = this.picked[0]?.held?.thumb === "left" ? "right" : "left";
    for (const view of this.picked) view.hold(this.side);
    this.arrange(false);
    this.say();
  }

  // --- state ----------------------------------------------------------------------------------

  show(setup) {
    const isOtherPlane = this.state?.table.plane !== setup.table.plane;
    this.state = setup;
    $("setup").hidden = false;
    this.showOffers(setup);
    if (!this.picked.length && setup.table.views.length) this.restore(setup);
    this.plane ??= setup.table.plane || undefined;
    if (setup.table.number === this.asked) this.asked = null;
    if (this.asked === null) this.takeTable(setup.table);
    if (isOtherPlane && setup.table.sides) {
      this.plane = setup.table.plane;
      this.showPlane(setup.table.sides);
    }
    this.picked.forEach((view, k) => {
      view.show(setup.pictures[view.number]);
      view.showHand(setup.hand?.views[k]);
    });
    this.plan.show(setup.scene, setup.advice, this.step === "aim" ? (setup.aim ?? null) : null);
    if (this.step === "hand" && this.asksForHand && !setup.busy) {
      this.asksForHand = false;
      if (!setup.hand && !setup.problem) this.send({ do: "hand" });
    }
    this.say();
  }

  takeTable({ views }) {
    for (const known of views) this.picked.find((view) => view.number === known.offer)?.take(known);
  }

  // Restores the picked views on a page that is opened later or again.
  restore(setup) {
    for (const { offer } of setup.table.views) this.pick(offer);
    if (setup.table.views.length >= 2 && !this.hasChosen) this.enter("table");
  }

  showOffers({ offers, pictures }) {
    for (let k = this.offers.length; k < offers.length; k++) this.offers.push({ ...offers[k], ...this.offerButton(k) });
    offers.forEach((offer, k) => {
      const card = this.offers[k];
      Object.assign(card, offer);
      card.button.disabled = Boolean(offer.problem);
      card.button.title = offer.problem || offer.source;
      setText(card.title, offer.name);
      setText(card.note, offer.problem || `${offer.live ? "live, " : ""}${offer.size[0]} × ${offer.size[1]}`);
      if (!offer.problem && pictures[k] && card.version !== pictures[k]) {
        card.version = pictures[k];
        card.image.src = `still/${k}.jpg?${pictures[k]}`;
      }
      if (!offer.problem && this.awaited.delete(offer.source) && !this.pickOf(k)) {
        this.pick(k);
        this.arrange(true);
      }
    });
    this.dropCard ??= this.buildDropCard();
    $("offers").append(this.dropCard);
  }

  offerButton(k) {
    const button = html("button", "offer", $("offers"));
    button.type = "button";
    button.ariaPressed = "false";
    const image = html("img", "", button);
    image.alt = "";
    const [title, note] = [html("b", "", button), html("small", "", button)];
    button.addEventListener("click", () => {
      this.pickOf(k) ? this.unpick(k) : this.pick(k);
      this.arrange(this.picked.length >= 2);
    });
    return { button, image, title, note };
  }

  buildDropCard() {
    const card = html("button", "offer drop", null);
    card.type = "button";
    html("b", "", card, "Drop recordings here");
    html("small", "", card, "or press to choose files; they are copied beside the rig file");
    card.addEventListener("click", () => $("films").click());
    return card;
  }

  async drop(files) {
    for (const file of [...files]) {
      this.dropping = `taking ${file.name}`;
      this.say();
      try {
        const answer = await fetch(`drop/${encodeURIComponent(file.name)}`, { method: "PUT", body: file, headers: { "content-type": "application/octet-stream" } });
        const words = (await answer.text()).trim();
        if (answer.ok) this.awaited.add(words);
        else this.refuse(words);
      } catch {
        this.refuse(`${file.name} has not come whole`);
      }
      this.dropping = "";
    }
    $("films").value = "";
    if (this.state) this.show(this.state);
  }

  pickOf(k) {
    return this.picked.find((view) => view.number === k);
  }

  pick(k) {
    const view = new SetUpView($("panes"), this.offers[k], k, this.state.templates, () => this.changed());
    this.picked.push(view);
    view.show(this.state.pictures[k]);
    view.enter(this.step);
    this.colour();
  }

  unpick(k) {
    const [view] = this.picked.splice(this.picked.indexOf(this.pickOf(k)), 1);
    view.element.remove();
    this.colour();
  }

  colour() {
    for (const { button } of this.offers) button.ariaPressed = "false";
    $("panes").style.setProperty("--columns", Math.ceil(Math.sqrt(this.picked.length)) || 1);
    $("panes").classList.toggle("many", this.picked.length > 2);
    this.picked.forEach((view, index) => {
      view.colour(index);
      this.offers[view.number].button.ariaPressed = "true";
      this.offers[view.number].button.style.setProperty("--tint", `var(--view-${index % 4})`);
    });
  }

  showPlane(sides) {
    this.select.value = this.plane in PLANES ? this.plane : OTHER;
    this.sliders.forEach(({ row, slider, value }, k) => {
      row.hidden = this.select.value !== OTHER;
      slider.value = sides[k];
      if (value !== document.activeElement) value.value = slider.value;
    });
  }

  // --- commands -------------------------------------------------------------------------------

  get open() {
    return this.picked.filter((view) => view.points.length < CORNERS);
  }

  changed() {
    if (this.open.length === 0 || this.open.every((view) => !view.points.length)) this.arrange(false);
    this.say();
    this.open[0]?.element.scrollIntoView({ block: "nearest" });
  }

  arrange(finds) {
    const views = this.picked.map(({ number, points, held }) => ({
      offer: number,
      points_px: points.length === CORNERS ? points : [],
      ...(held && { held }),
    }));
    this.asked = ++this.number;
    this.send({ do: "arrange", views, plane: this.plane ?? "", finds, number: this.asked });
    this.say();
  }

  // --- navigation -----------------------------------------------------------------------------

  go(by) {
    const k = STEPS.findIndex(([step]) => step === this.step) + by;
    if (STEPS[k]) this.choose(STEPS[k][0]);
  }

  // Every step needs the views, and those after the table need it.
  allows(step) {
    if (step === "views") return true;
    return this.picked.length >= 2 && (step === "table" || this.isReady);
  }

  choose(step) {
    if (!this.allows(step)) return;
    this.hasChosen = true;
    this.enter(step);
  }

  enter(step) {
    this.step = step;
    $("setup").dataset.step = step;
    $("step").scrollTop = 0;
    for (const view of this.picked) view.enter(step);
    this.asksForHand = step === "hand" && !this.state?.hand?.found;
    if (this.isLooking && step !== "hand" && step !== "aim") this.send({ do: "leave" });
    if (this.state) this.show(this.state);
  }

  get isLooking() {
    return /hand|learning/.test(this.state?.busy ?? "");
  }

  get isContradicted() {
    return this.state.words?.some(({ severity }) => severity === "error") ?? false;
  }

  get isReady() {
    const views = this.state?.table.views ?? [];
    return views.length >= 2 && this.open.length === 0 && views.every(({ points }) => points.length === CORNERS) && Boolean(this.state.scene);
  }

  refuse(words) {
    this.asked = null;
    this.refused = { words, until: performance.now() + REFUSED_FOR_MS };
    this.say();
  }

  key(event) {
    const isTyped = /SELECT|INPUT/.test(event.target.tagName);
    if (event.ctrlKey || event.metaKey || event.altKey || isTyped || $("help").open) return;
    const does = { n: () => this.go(1), b: () => this.go(-1), c: () => this.send({ do: "take" }) };
    const digit = Number(event.key);
    if (digit >= 1 && digit <= STEPS.length) this.choose(STEPS[digit - 1][0]);
    else if (event.key === "Escape" && this.isLooking) this.send({ do: "leave" });
    else if (does[event.key.toLowerCase()]) does[event.key.toLowerCase()]();
    else return;
    event.preventDefault();
  }

  connect(isConnected) {
    this.isConnected = isConnected;
    this.asked = null;
    this.say();
  }

  // --- messages -------------------------------------------------------------------------------

  say() {
    if (!this.state || !this.isOpen) return;
    const { busy, problem, words, advice } = this.state;
    const [title, detail, status, badge] = this.headline();
    $("point").hidden = true;
    $("words").hidden = false;
    setText($("words"), title);
    setText($("detail"), detail || "\u00a0");
    $("detail").title = detail;
    document.documentElement.dataset.status = status;
    $("badge-mark").setAttribute("href", `#mark-${status}`);
    setText($("badge-word"), badge);
    const refused = performance.now() < this.refused.until ? this.refused.words : "";
    setText($("doing"), refused || this.dropping || problem || (busy ? `${busy} …` : `rig.toml goes to ${this.state.folder}`));
    $("doing").classList.toggle("bad", Boolean(refused || problem));
    $("begin").disabled = !this.isConnected || !this.isReady || busy === "beginning";
    $("previous").disabled = this.step === "views";
    const next = STEPS[STEPS.findIndex(([step]) => step === this.step) + 1];
    $("next").disabled = !next || !this.allows(next[0]);
    legend($("legend"), this.step === "aim" ? null : advice);
    this.sayAsks();
    this.sayWrong(words);
    this.saySteps();
    this.saySummary();
  }

  headline() {
    const { busy, problem, hand, aim, advice, table } = this.state;
    if (!this.isConnected) return ["no connection to fingerpost", "if it was started anew, open the address that it prints", "lost", "cut off"];
    if (problem) return ["that cannot be", problem, "lost", "no"];
    if (busy && !this.isLooking && this.step !== "views") return [busy, "this takes some seconds", "acquiring", "set-up"];
    const waiting = (title, detail) => [title, detail, "waiting", "set-up"];
    const done = (title, detail) => [title, detail, "ok", "ready"];
    const open = this.open[0];
    if (!this.offers.some((offer) => !offer.problem) && !busy) {
      return waiting("no camera and no recording here", "plug cameras in, drop recordings onto this page, or start fingerpost live in their folder");
    }
    if (this.picked.length < 2) return waiting(this.picked.length ? "pick one more view" : "pick two views, or more", "they see the same table and the pointing hand from different sides");
    if (this.step === "views") return done(`${this.picked.length} views`, "next: the table");
    if (open) {
      const missing = table.views.find(({ offer, missing }) => missing && offer === open.number)?.missing;
      if (missing && !open.points.length) return waiting(`not found in ${open.offer.name}`, `${missing.split(";")[0]}: see below its picture, or click its corners`);
      return waiting(`click corner ${open.points.length + 1} in ${open.offer.name}`, "around a sheet or a mat on the table, the same corner first in every view");
    }
    if (this.step === "table" && this.isContradicted) return waiting("the corners look wrong", "see below what contradicts them; drag them to the right places");
    if (this.step === "table" && advice?.most === null) return waiting("no hand would have a point", `does it measure ${table.sides.join(" × ")} mm? choose what lies on the table, or set its sides`);
    if (this.step === "table") return done("the table is known", advice ? errorsWords(advice) : "drag a corner to move it, or use the arrow keys on it");
    if (this.step === "hand") {
      if (this.isLooking) return ["point at the table", "index finger out, thumb up, in sight of every view", "acquiring", "looking"];
      if (!hand && this.picked.some((view) => view.held)) return waiting("hold your hand up to the template", "drag it, or its knuckle to turn and scale it; then look for the hand");
      return hand?.found ? done("the hand is found", `${this.handWords(hand)}; it will be found wherever it comes in`) : waiting("no hand is found", hand ? "see below each picture what would help" : "look for it, or go on: it will be found when it comes");
    }
    if (this.step === "aim") return this.aimLine(aim, waiting, done);
    return done("ready: save and begin", `writes rig.toml to ${this.state.folder}`);
  }

  handWords({ views }) {
    const count = views.filter(({ tip }) => tip).length;
    return count === views.length ? "in every view" : `in ${count} of ${views.length} views`;
  }

  aimLine(aim, waiting, done) {
    if (aim?.running) {
      const next = aim.visits.length + 1;
      return [`point at ${Math.min(next, aim.places.length)} and stay there`, aim.words || `${aim.visits.length} of ${aim.places.length}`, aim.point ? "ok" : "acquiring", "learning"];
    }
    if (aim?.off !== undefined) return done(`you point ${aim.off} ${aim.unit} beside; that is taken off`, `what is left: ${aim.left} ${aim.unit}, of a place that was not learned from`);
    const detail = aim ? `${aim.visits.length} of ${aim.places.length} places were pointed at` : "five places light up; point at each for a second. It may be left out";
    return waiting("learn how you point", detail);
  }

  sayAsks() {
    const { aim } = this.state;
    for (const ask of $("asks").children) if (ask.dataset.step) ask.hidden = ask.dataset.step !== this.step;
    this.planeAsk.hidden = this.step !== "table";
    setText(this.look, this.isLooking ? "Leave off" : this.state.hand ? "Look again" : "Look for the hand");
    const held = this.picked.find((view) => view.held)?.held;
    this.hold.ariaPressed = String(Boolean(held));
    this.thumb.hidden ||= !held;
    setText(this.thumb, held?.thumb === "right" ? "Thumb to the left" : "Thumb to the right");
    setText(this.learn, this.isLooking ? "Leave off" : aim ? "Again" : "Begin");
    this.forget.hidden ||= aim?.off === undefined;
  }

  sayWrong(words) {
    const shown = this.step === "table" || this.step === "save" ? words : [];
    const known = JSON.stringify(shown);
    if (known === this.wrong) return;
    this.wrong = known;
    $("wrong").replaceChildren(
      ...shown.map(({ severity, view, text }) => {
        const item = html("li", severity, null);
        html("b", "", item, { error: "wrong", warning: "could be better", advice: "advice" }[severity] + (view ? `: ${view}` : ""));
        html("span", "", item, text);
        return item;
      }),
    );
    $("wrong").hidden = !shown.length;
  }

  saySteps() {
    const { hand, aim, table } = this.state;
    const sigmas = table.views.map(({ sigma }) => sigma).filter((sigma) => sigma !== null);
    const found = {
      views: this.picked.length >= 2 && (this.picked.length > 2 ? `${this.picked.length} views` : this.picked.map((view) => view.offer.name).join(", ")),
      table: this.isReady && `± ${Math.max(...sigmas).toFixed(2)} px`,
      hand: hand?.found && "found",
      aim: aim?.off !== undefined && `± ${aim.left} ${aim.unit}`,
      save: false,
    };
    for (const [step, { button, found: words }] of this.steps) {
      button.disabled = !this.allows(step);
      button.title = button.disabled ? (this.picked.length < 2 ? "first pick two views" : "first the table must be known") : "";
      button.setAttribute("aria-current", this.step === step ? "step" : "false");
      button.classList.toggle("done", Boolean(found[step]));
      setText(words, found[step] || { hand: "may wait", aim: "may be left out" }[step] || "");
    }
  }

  saySummary() {
    $("summary").hidden = this.step !== "save";
    if (this.step !== "save") return;
    const { table, advice, hand, aim } = this.state;
    const rows = [
      ["views", this.picked.map((view) => view.offer.name).join(", ")],
      ["plane", `${PLANES[table.plane] ?? "rectangle"}, ${(table.sides ?? []).join(" × ")} mm`],
      ["corners", table.views.map(({ sigma, found }) => `± ${sigma} px ${found ? "found" : "by hand"}`).join("; ")],
      ["expected errors", advice ? errorsWords(advice, "half") : "unknown"],
      ["hand", hand?.found ? `found ${this.handWords(hand)}` : "to be found when it comes"],
      ["your aim", aim?.off === undefined ? "not learned" : `${aim.off} ${aim.unit} beside, ${aim.left} ${aim.unit} after it is taken off`],
    ];
    const known = JSON.stringify(rows);
    if (known === this.summed) return;
    this.summed = known;
    $("summary").replaceChildren(...rows.flatMap(([name, words]) => [html("dt", "", null, name), html("dd", "", null, words)]));
  }

  hide() {
    $("setup").hidden = true;
  }
}
