// Keyboard shortcuts of the whole page. Stop keys have priority.

const FRAMES_AT_ONCE = 25;

export function bindKeys(does) {
  const keys = {
    p: does.toggle,
    l: does.large,
    e: does.edges,
    t: does.theme,
    c: does.take,
    "?": does.help,
    i: does.explain,
    n: does.bookmark,
    ",": () => does.nextBookmark(-1),
    ".": () => does.nextBookmark(1),
    Home: () => does.seek(0),
    End: does.last,
  };
  const sets = () => document.documentElement.classList.contains("setting-up");
  addEventListener("keydown", (event) => {
    if (sets()) return void does.setUp(event);
    if (event.key === " " || event.key === "Escape") {
      does.stop();
      // Space must not press a focused button; Escape still closes dialogs.
      if (event.key === " ") event.preventDefault();
      return;
    }
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key === "ArrowLeft" || event.key === "ArrowRight") {
      const by = (event.key === "ArrowLeft" ? -1 : 1) * (event.shiftKey ? FRAMES_AT_ONCE : 1);
      does.step(by);
    } else if (/^[0-9]$/.test(event.key)) does.focus(Number(event.key));
    else if (keys[event.key] ?? keys[event.key.toLowerCase()]) (keys[event.key] ?? keys[event.key.toLowerCase()])();
    else return;
    event.preventDefault();
  }, true);
  // Browsers press a focused button at keyup of the space bar.
  addEventListener("keyup", (event) => event.key === " " && !sets() && event.preventDefault(), true);
}
