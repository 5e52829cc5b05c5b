// Mouse, fingers and keys over the photograph.
//
// Promises: whatever a pointer does, keys do too; a press that moves is a drag, one that does not puts a point.

// ------------------------------------------------------------------------------------------------------ mouse and fingers

const pointers = new Map();
let press = null;

const placeOf = (event) => {
  const box = canvas.getBoundingClientRect();
  return [event.clientX - box.left, event.clientY - box.top];
};

canvas.addEventListener("pointerdown", (event) => {
  if (event.button > 0) return;
  canvas.setPointerCapture(event.pointerId);
  const place = placeOf(event);
  pointers.set(event.pointerId, place);
  options.keyboard = false;
  if (pointers.size > 1) {
    press = null;
    return;
  }
  const touch = event.pointerType === "touch";
  press = { start: place, last: place, handle: nearest(place, touch ? 24 : 10), moved: false, touch };
  if (press.handle) press.grip = chosenPixel(press.handle).map((part, i) => part - toPixel(view, place)[i]);
});

const chosenPixel = ({ measure, point }) => sheet.measures[measure].points[point].pixel;

canvas.addEventListener("pointermove", (event) => {
  const place = placeOf(event);
  const before = pointers.get(event.pointerId);
  if (pointers.size === 2 && before) {
    const other = [...pointers].find(([id]) => id !== event.pointerId)[1];
    const [apart, now] = [
      hypot(before[0] - other[0], before[1] - other[1]),
      hypot(place[0] - other[0], place[1] - other[1]),
    ];
    pan(view, (place[0] - before[0]) / 2, (place[1] - before[1]) / 2);
    zoom(view, now / Math.max(apart, 1), [(place[0] + other[0]) / 2, (place[1] + other[1]) / 2]);
    pointers.set(event.pointerId, place);
    soon("view");
    return;
  }
  if (before) pointers.set(event.pointerId, place);
  if (!press) {
    if (event.pointerType !== "touch") {
      options.keyboard = false;
      cursor = { pixel: toPixel(view, place) };
      canvas.style.cursor = nearest(place, 10) ? "grab" : "crosshair";
      readCursor();
      soon("view", "plan");
    }
    return;
  }
  press.moved ||= hypot(place[0] - press.start[0], place[1] - press.start[1]) > (press.touch ? 8 : 4);
  if (!press.moved) return;
  if (press.handle) {
    if (!press.dragging) remember(sheet);
    press.dragging = true;
    sheet.chosen = press.handle;
    const pixel = toPixel(view, place).map((part, i) => part + press.grip[i]);
    sheet.measures[press.handle.measure].points[press.handle.point].pixel = pixel;
    cursor = { pixel };
    changed();
  } else {
    pan(view, place[0] - press.last[0], place[1] - press.last[1]);
    canvas.style.cursor = "grabbing";
    soon("view");
  }
  press.last = place;
});

function released(event) {
  pointers.delete(event.pointerId);
  const done = press;
  press = null;
  canvas.style.cursor = "crosshair";
  if (!done || event.type === "pointercancel" || done.moved) return;
  if (done.handle) clickPoint(done.handle);
  else put(toPixel(view, done.start));
  if (done.touch) cursor = null;
}
canvas.addEventListener("pointerup", released);
canvas.addEventListener("pointercancel", released);
canvas.addEventListener("pointerleave", () => {
  if (press || options.keyboard) return;
  cursor = null;
  readCursor();
  soon("view", "plan");
});
canvas.addEventListener(
  "wheel",
  (event) => {
    event.preventDefault();
    const lines = event.deltaMode === 1 ? 16 : event.deltaMode === 2 ? 400 : 1;
    zoomBy(Math.exp(-event.deltaY * lines * (event.ctrlKey ? 0.01 : 0.0015)), placeOf(event));
  },
  { passive: false },
);
canvas.addEventListener("dblclick", (event) => {
  event.preventDefault();
  if (openMeasure(sheet)?.kind === "area") doIt(finish);
});

// ------------------------------------------------------------------------------------------------------------------ keys

const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
const TOOL_KEYS = { l: "length", a: "area", g: "angle", p: "point" };

function moveBy([du, dv], event) {
  const point = chosenPoint(sheet);
  const step = event.altKey ? 0.1 : event.shiftKey ? (point ? 10 : 20) : 1;
  options.keyboard = true;
  if (point) {
    remember(sheet);
    point.pixel = [point.pixel[0] + du * step * 0.1, point.pixel[1] + dv * step * 0.1];
    cursor = { pixel: point.pixel };
    bringIntoSight(view, point.pixel);
    changed();
    return;
  }
  const start = cursor ? cursor.pixel : middleOfView();
  const most = data.size.map((side) => side - 0.5);
  cursor = { pixel: [du, dv].map((part, i) => Math.min(Math.max(start[i] + part * step, -0.5), most[i])) };
  bringIntoSight(view, cursor.pixel);
  readCursor();
  soon("view", "plan");
}

// A whole pixel, so that steps of one stay on whole ones.
const middleOfView = () => toPixel(view, [canvas.clientWidth / 2, canvas.clientHeight / 2]).map(Math.round);

function putAtCrosshair() {
  options.keyboard = true;
  sheet.chosen = null;
  cursor ??= { pixel: middleOfView() };
  put([...cursor.pixel]);
  sheet.chosen = null; // the arrows go on with the crosshair
  soon("view");
}

function letGo() {
  if (sheet.chosen) sheet.chosen = null;
  else if (openMeasure(sheet)) finish(sheet);
  changed();
}

function step(side) {
  options.keyboard = true;
  chooseNext(sheet, side);
  const point = chosenPoint(sheet);
  if (point) {
    cursor = { pixel: point.pixel };
    bringIntoSight(view, point.pixel);
  }
  changed();
}

canvas.addEventListener("keydown", (event) => {
  const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  if (event.ctrlKey || event.metaKey) return;
  const does = {
    Enter: putAtCrosshair,
    " ": putAtCrosshair,
    Escape: letGo,
    Delete: () => sheet.chosen && doIt(() => deletePoint(sheet, sheet.chosen)),
    n: () => step(1),
    b: () => step(-1),
    f: () => doIt(finish),
    r: () => toggle("grid"),
    m: () => toggle("loupe"),
    "+": () => zoomBy(1.25, cursor && onCanvas(view, cursor.pixel)),
    "=": () => zoomBy(1.25, cursor && onCanvas(view, cursor.pixel)),
    "-": () => zoomBy(0.8, cursor && onCanvas(view, cursor.pixel)),
    0: fitAgain,
  };
  does.Backspace = does.Delete;
  if (ARROWS[key]) moveBy(ARROWS[key], event);
  else if (event.altKey) return;
  else if (TOOL_KEYS[key]) choose(TOOL_KEYS[key]);
  else if (does[key]) does[key]();
  else return;
  event.preventDefault();
});

document.addEventListener("keydown", (event) => {
  if (!(event.ctrlKey || event.metaKey) || event.altKey || /^(INPUT|SELECT|TEXTAREA)$/.test(event.target.tagName))
    return;
  const key = event.key.toLowerCase();
  if (key === "z" && !event.shiftKey) doIt(undo);
  else if (key === "y" || key === "z") doIt(redo);
  else return;
  event.preventDefault();
});
