// Layout of views and plan: of three arrangements, the one that shows most.

import { PlanPanel } from "./plan.js";
import { ViewPanel } from "./view.js";

const GAP_PX = 14;
const HEAD_PX = 34;
const CAPTION_PX = 24;
const LARGE_EMPHASIS = 1.5;
const USUAL_ASPECT = 4 / 3;
const VIEWS_SHARE = 0.55; // of the stage, at most
const PLAN_MARGIN_PX = [74, 66];

export class Stage {
  constructor(element) {
    this.element = element;
    this.views = [];
    this.plan = null;
    this.alone = null;
    this.isLarge = false;
    new ResizeObserver(() => this.layOut()).observe(element);
  }

  open(rig) {
    this.element.replaceChildren();
    this.views = rig.views.map((name, k) => new ViewPanel(this.element, k, name, rig.views.length));
    this.plan = new PlanPanel(this.element, rig);
    this.aspects = "";
    this.alone = null;
    this.layOut();
  }

  get panels() {
    return [...this.views, this.plan];
  }

  show(scene, pictures) {
    this.views.forEach((view, k) => view.show(scene.views[k], pictures[k]));
    this.plan.show(scene.plan, scene.head.status);
    const aspects = this.views.map((view) => view.size?.join("x")).join();
    if (aspects !== this.aspects) {
      this.aspects = aspects;
      this.layOut();
    }
  }

  // Shows one panel alone, by its number from 1; 0, or the panel already alone, shows all.
  focus(number) {
    if (number > this.panels.length) return;
    this.alone = number === 0 || this.alone === number - 1 ? null : number - 1;
    this.layOut();
  }

  showEdges(shows) {
    for (const view of this.views) {
      view.showsEdges = shows;
      if (view.last) view.draw(view.last);
    }
  }

  enlarge(isLarge) {
    this.isLarge = isLarge;
    this.layOut();
  }

  layOut() {
    const [width, height] = [this.element.clientWidth, this.element.clientHeight];
    if (!this.plan || !width || !height) return;
    const emphasis = this.isLarge ? LARGE_EMPHASIS : 1;
    const alone = this.isLarge && this.alone === null ? this.views.length : this.alone;
    this.panels.forEach((panel, k) => panel.element.classList.toggle("away", alone !== null && k !== alone));
    if (alone !== null) {
      this.panels[alone].put(alone < this.views.length ? this.whole(alone, width, height) : { left: 0, top: 0, width, height }, emphasis);
      return;
    }
    const count = this.views.length;
    const columns = Array.from({ length: count }, (_, k) => k + 1);
    const ways = [...columns.flatMap((each) => [beside, above].map((way) => way(width, height, count, this.aspect(), this.plan.aspect, each))), line(width, height, count, this.aspect(), this.plan.aspect)];
    const { views, plan } = ways.reduce((a, b) => (b.merit > a.merit ? b : a));
    const bottom = Math.max(...[...views, plan].map((place) => place.top + place.height));
    const down = Math.max((height - bottom) / 2, 0);
    this.views.forEach((view, k) => view.put({ ...views[k], top: views[k].top + down }, emphasis));
    this.plan.put({ ...plan, top: plan.top + down }, emphasis);
  }

  aspect() {
    const known = this.views.filter((view) => view.size).map((view) => view.size[0] / view.size[1]);
    return known.length ? known.reduce((a, b) => a + b) / known.length : USUAL_ASPECT;
  }

  whole(k, width, height) {
    const aspect = this.views[k].size ? this.views[k].size[0] / this.views[k].size[1] : USUAL_ASPECT;
    const wide = Math.min(width, (height - HEAD_PX - CAPTION_PX) * aspect);
    return { left: (width - wide) / 2, top: 0, width: wide, height: wide / aspect + HEAD_PX + CAPTION_PX };
  }
}

// Views of one size in rows of `columns`, as large as a width and a height allow.
function tiles(width, height, count, aspect, columns) {
  const extra = HEAD_PX + CAPTION_PX;
  const rows = Math.ceil(count / columns);
  const room = (height - (rows - 1) * GAP_PX) / rows - extra;
  const wide = Math.min((width - (columns - 1) * GAP_PX) / columns, room * aspect);
  const each = wide / aspect + extra;
  const views = Array.from({ length: count }, (_, k) => ({ left: (k % columns) * (wide + GAP_PX), top: Math.floor(k / columns) * (each + GAP_PX), width: wide, height: each }));
  return { views, across: columns * (wide + GAP_PX) - GAP_PX, down: rows * (each + GAP_PX) - GAP_PX };
}

// The plan at the right of the views.
function beside(width, height, count, aspect, planAspect, columns) {
  const { views, across, down } = tiles(VIEWS_SHARE * width, height, count, aspect, columns);
  const left = across + GAP_PX;
  return judged(views, { left, top: 0, width: width - left, height: Math.max(down, Math.min(height, width - across)) - CAPTION_PX }, planAspect);
}

// The plan below the views.
function above(width, height, count, aspect, planAspect, columns) {
  const { views, across, down } = tiles(width, VIEWS_SHARE * height, count, aspect, columns);
  const left = (width - across) / 2;
  return judged(views.map((view) => ({ ...view, left: left + view.left })), { left: 0, top: down, width, height: height - down }, planAspect);
}

// Views and plan in one row.
function line(width, height, count, aspect, planAspect) {
  const extra = HEAD_PX + CAPTION_PX;
  const wide = Math.min((width - count * GAP_PX) / (count + 1), (height - extra) * aspect);
  const each = wide / aspect + extra;
  const views = Array.from({ length: count }, (_, k) => ({ left: k * (wide + GAP_PX), top: 0, width: wide, height: each }));
  const left = count * (wide + GAP_PX);
  const wanted = (width - left - PLAN_MARGIN_PX[0]) / planAspect + PLAN_MARGIN_PX[1] + HEAD_PX;
  return judged(views, { left, top: 0, width: width - left, height: Math.min(height, Math.max(each - CAPTION_PX, wanted)) }, planAspect);
}

// The merit of a layout: sum of the log areas of plan and, on average, views.
function judged(views, plan, planAspect) {
  const area = ({ width, height }) => Math.max(width * (height - HEAD_PX - CAPTION_PX), 1);
  const scale = Math.min((plan.width - PLAN_MARGIN_PX[0]) / planAspect, plan.height - HEAD_PX - PLAN_MARGIN_PX[1]);
  const merit = views.reduce((sum, view) => sum + Math.log(area(view)), 0) / views.length + Math.log(Math.max(scale, 1) ** 2 * planAspect);
  return { views, plan, merit };
}
