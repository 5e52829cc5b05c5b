// The measuring page: what clicks, fingers and keys do, and when what is drawn anew.
//
// Promises: whatever a pointer does, keys do too; a press that moves is a drag, one that does not puts a point.

const data = JSON.parse(byId("measuring-data").textContent);
const image = byId("m-image");
const canvas = byId("m-photo");
const planCanvas = byId("m-plan");
const sheet = makeSheet();
const view = makeView(canvas, image, data.size);
const options = { grid: true, loupe: true, keyboard: false };
const overlay = { texts: [] };
let [scene, plan, planPicture, bytes, results, cursor] = [null, null, null, null, [], null];

// -------------------------------------------------------------------------------------------------- the plane, the noise

function choosePlane() {
  const { normal, offset } = data.model.planes[Number(byId("m-plane").value)];
  const height = Number(byId("m-height").value);
  const sigma = Number(byId("m-sigma").value);
  byId("m-height").setAttribute("aria-invalid", String(byId("m-height").value === "" || !Number.isFinite(height)));
  byId("m-sigma").setAttribute("aria-invalid", String(!(sigma > 0)));
  const plane = parallelPlane(makePlane(normal, offset), makeCamera(data.model.camera), Number.isFinite(height) ? height : 0);
  const noise = sigma > 0 ? sigma : data.model.sigma;
  scene = makeScene(data.model, plane, noise, data.model.pixels_too && noise === data.model.sigma);
  overlay.nowhere = shadeOf(scene, data.size);
  overlay.outside = outsideOf(data.model.region, data.size);
  plan = makePlan(scene, data.size);
  overlay.grid = null;
  if (plan.extent) {
    const corners = plan.extent[0].flatMap((a) => plan.extent[1].map((b) => fromPlan(plan, a, b)));
    const extent = plane.axes.map((axis) => corners.map((corner) => dot(corner, axis))).map((values) => [Math.min(...values), Math.max(...values)]);
    plan.step = niceStep(Math.max(...extent.map(([low, high]) => high - low)) / 12);
    overlay.grid = gridOf(scene, extent, plan.step);
  }
  fillFacts(data, scene);
  planPicture = null;
  changed();
}

// ---------------------------------------------------------------------------------------------------------- drawing anew

const due = new Set();
function soon(...what) {
  if (!due.size) requestAnimationFrame(redraw);
  for (const each of what) due.add(each);
}

function redraw() {
  const now = new Set(due);
  due.clear();
  if (now.has("plan") && plan.extent && !planPicture && image.naturalWidth) renderPlan();
  if (now.has("view")) drawView(view, sheet, overlay, cursor, options);
  if (now.has("plan")) {
    planCanvas.hidden = !plan.extent;
    const step = plan.extent && plan.step ? ` Lines every ${plainNumber(plan.step)}${data.unit ? ` ${data.unit}` : ""}.` : "";
    byId("m-plan-text").textContent = plan.extent ? `The plane from above, to scale.${options.grid ? step : ""}` : "The camera sees nothing of this plane.";
    if (plan.extent) drawPlan(planCanvas, plan, planPicture, sheet, cursor && pointAt(scene.map, cursor.pixel).point, data.unit, options.grid);
  }
}

function renderPlan() {
  bytes ??= bytesOf(image);
  const layout = planLayout(plan, Math.max(planCanvas.clientWidth, 200));
  const shrink = Math.min((window.devicePixelRatio || 1), Math.sqrt(240000 / (layout.columns * layout.rows)));
  const [columns, rows] = [layout.columns, layout.rows].map((side) => Math.max(Math.round(side * shrink), 2));
  planPicture = document.createElement("canvas");
  [planPicture.width, planPicture.height] = [columns, rows];
  planPicture.getContext("2d").putImageData(pictureOf(plan, bytes, data.size, columns, rows), 0, 0);
}

// The sheet, the plane or the noise is another one.
function changed() {
  results = sheet.measures.map((measure) => ({
    quantities: quantitiesOf(scene, measure),
    measured: measure.points.map(({ pixel }) => measurePoint(scene, pixel)),
  }));
  overlay.texts = sheet.measures.map((measure, m) => {
    const [main] = results[m].quantities;
    return main && !Number.isNaN(main.value) ? withDeviation(main.value, main.deviation, unitOf(main.what, data.unit)) : "";
  });
  fillAnswer(sheet, results, data.unit);
  fillMeasures(sheet, results, data.unit, actions);
  fillPoints(sheet, results, data.unit, actions);
  for (const button of document.querySelectorAll("[data-tool]")) button.setAttribute("aria-pressed", String(button.dataset.tool === sheet.tool));
  byId("m-undo").disabled = !sheet.past.length;
  byId("m-redo").disabled = !sheet.future.length;
  byId("m-finish").hidden = openMeasure(sheet)?.kind !== "area";
  readCursor();
  soon("view", "plan");
}

function readCursor() {
  const line = byId("m-cursor");
  line.classList.remove("m-doubt");
  if (!cursor) {
    line.textContent = "Move over the photograph to read the plane.";
    return;
  }
  const measured = measurePoint(scene, cursor.pixel);
  const [u, v] = cursor.pixel.map((part) => part.toFixed(1).replace("-", "−"));
  let text = `pixel ${u}, ${v}: ${REASONS[measured.reason]}`;
  if (measured.point) {
    const spread = deviationsOf(measured);
    const unit = data.unit ? ` ${data.unit}` : "";
    text = `pixel ${u}, ${v}: ${"xyz".split("").map((axis, i) => `${axis} ${withDeviation(measured.point[i], spread[i], "")}`).join(", ")}${unit}`;
    if (measured.extrapolated) text += " (extrapolated)";
  }
  line.classList.toggle("m-doubt", !measured.point || measured.extrapolated);
  line.textContent = text;
  if (options.keyboard) byId("m-spoken").textContent = text;
}

// ---------------------------------------------------------------------------------------------------------- what is done

const actions = {
  renameMeasure(m, text) {
    remember(sheet);
    sheet.measures[m].name = text.slice(0, 300);
    changed();
  },
  renamePoint(m, n, text) {
    remember(sheet);
    sheet.measures[m].points[n].name = text.slice(0, 300);
    changed();
  },
  movePoint(m, n, axis, value) {
    if (Number.isFinite(value)) {
      remember(sheet);
      sheet.measures[m].points[n].pixel[axis] = value;
    }
    changed();
  },
  deletePoint(m, n) {
    deletePoint(sheet, { measure: m, point: n });
    canvas.focus();
    changed();
  },
  deleteMeasure(m) {
    deleteMeasure(sheet, m);
    canvas.focus();
    changed();
  },
};

// On the first corner of an open area a click ends it. On another point a click chooses it; but where a measure still
// wants a point, or a tool was just taken, or the point is chosen already, it puts one just there.
function clickPoint(handle) {
  const open = openMeasure(sheet);
  const own = open && sheet.measures[handle.measure] === open;
  const again = sheet.chosen?.measure === handle.measure && sheet.chosen?.point === handle.point;
  if (own && open.kind === "area" && handle.point === 0 && open.points.length > 2) finish(sheet);
  else if (own || !(open || again || sheet.prompted)) sheet.chosen = handle;
  else putPoint(sheet, [...chosenPixel(handle)]);
  changed();
}

function put(pixel) {
  const handle = nearest(onCanvas(view, pixel), 3);
  if (handle) return clickPoint(handle);
  putPoint(sheet, pixel);
  changed();
}

function nearest(place, within) {
  let best = null;
  for (const [measure, { points }] of sheet.measures.entries()) {
    for (const [point, { pixel }] of points.entries()) {
      const [x, y] = onCanvas(view, pixel);
      const distance = hypot(x - place[0], y - place[1]);
      if (distance <= within && (!best || distance < best.distance)) best = { measure, point, distance };
    }
  }
  return best && { measure: best.measure, point: best.point };
}

function doIt(step) {
  step(sheet);
  changed();
}

function zoomBy(factor, place) {
  zoom(view, factor, place);
  soon("view");
}

function toggle(option) {
  options[option] = !options[option];
  byId(`m-${option}`).setAttribute("aria-pressed", String(options[option]));
  soon("view", "plan");
}

function choose(tool) {
  chooseTool(sheet, tool);
  changed();
}

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
    const [apart, now] = [hypot(before[0] - other[0], before[1] - other[1]), hypot(place[0] - other[0], place[1] - other[1])];
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
canvas.addEventListener("wheel", (event) => {
  event.preventDefault();
  const lines = event.deltaMode === 1 ? 16 : event.deltaMode === 2 ? 400 : 1;
  zoomBy(Math.exp(-event.deltaY * lines * (event.ctrlKey ? 0.01 : 0.0015)), placeOf(event));
}, { passive: false });
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
  if (!(event.ctrlKey || event.metaKey) || event.altKey || /^(INPUT|SELECT|TEXTAREA)$/.test(event.target.tagName)) return;
  const key = event.key.toLowerCase();
  if (key === "z" && !event.shiftKey) doIt(undo);
  else if (key === "y" || key === "z") doIt(redo);
  else return;
  event.preventDefault();
});

// --------------------------------------------------------------------------------------------------- buttons and fields

function fitAgain() {
  fit(view);
  soon("view");
}

async function copy(text, what) {
  let copied = true;
  try {
    await navigator.clipboard.writeText(text);
  } catch {
    const area = element("textarea", { "aria-hidden": "true", class: "m-hidden" });
    area.value = text;
    byId("measuring").append(area);
    area.select();
    copied = document.execCommand("copy");
    area.remove();
  }
  byId("m-copied").textContent = copied ? `Copied as ${what}.` : "The browser does not let this page copy.";
}

function exported() {
  const chosen = data.model.planes[Number(byId("m-plane").value)];
  const { normal, offset } = scene.map.plane;
  const plane = { name: chosen.name, normal, offset, height: Number(byId("m-height").value) };
  const context = { photograph: data.name, unit: data.unit, plane, pixel_sigma: scene.sigma, includes: data.model.includes, doubts: data.model.doubts };
  return asDocument(sheet, scene, context);
}

const CLICKS = {
  "m-undo": () => doIt(undo),
  "m-redo": () => doIt(redo),
  "m-closer": () => zoomBy(1.25),
  "m-wider": () => zoomBy(0.8),
  "m-fit": fitAgain,
  "m-grid": () => toggle("grid"),
  "m-loupe": () => toggle("loupe"),
  "m-finish": () => doIt(finish),
  "m-copy-csv": () => copy(asTable(exported()), "CSV"),
  "m-copy-json": () => copy(JSON.stringify(exported(), null, 1), "JSON"),
  "m-clear": () => doIt(() => {
    remember(sheet);
    sheet.measures = [];
    sheet.chosen = null;
  }),
};
for (const [id, listener] of Object.entries(CLICKS)) byId(id).addEventListener("click", listener);
for (const button of document.querySelectorAll("[data-tool]")) button.addEventListener("click", () => choose(button.dataset.tool));
for (const id of ["m-plane", "m-height", "m-sigma"]) byId(id).addEventListener("change", choosePlane);
byId("m-settings").addEventListener("submit", (event) => {
  event.preventDefault();
  choosePlane();
});

// ------------------------------------------------------------------------------------------------------------- beginning

const PLANE_NAMES = { board: "the board's face", given: "the given plane" };
byId("m-plane").append(...data.model.planes.map(({ name, ...plane }, n) => element("option", { value: n, text: `${PLANE_NAMES[name] ?? "the plane"}, ${equationOf(plane)}` })));
byId("m-height-unit").textContent = data.unit ? `, ${data.unit}` : "";
byId("m-sigma").value = Number(data.model.sigma.toPrecision(4)) === data.model.sigma ? data.model.sigma : String(data.model.sigma);
canvas.setAttribute("aria-label", `Photograph ${data.name}, to measure in`);

new ResizeObserver(() => {
  const height = Math.max(Math.min((canvas.clientWidth * data.size[1]) / data.size[0], 0.78 * window.innerHeight), 180);
  canvas.style.height = `${Math.round(height)}px`;
  if (view.fitted) fit(view);
  planPicture = null;
  soon("view", "plan");
}).observe(canvas.parentElement);
if (!image.complete) image.addEventListener("load", () => soon("view", "plan"));
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => soon("view", "plan"));
choosePlane();
