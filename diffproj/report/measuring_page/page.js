// The measuring page's state: photograph, plane, noise and sheet; what can be done with them, and what is drawn anew.
//
// Promises: after every change the answer, the tables and both pictures say the same.

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
  const plane = parallelPlane(
    makePlane(normal, offset),
    makeCamera(data.model.camera),
    Number.isFinite(height) ? height : 0,
  );
  const noise = sigma > 0 ? sigma : data.model.sigma;
  scene = makeScene(data.model, plane, noise, data.model.pixels_too && noise === data.model.sigma);
  overlay.nowhere = shadeOf(scene, data.size);
  overlay.outside = outsideOf(data.model.region, data.size);
  plan = makePlan(scene, data.size);
  overlay.grid = null;
  if (plan.extent) {
    const corners = plan.extent[0].flatMap((a) => plan.extent[1].map((b) => fromPlan(plan, a, b)));
    const extent = plane.axes
      .map((axis) => corners.map((corner) => dot(corner, axis)))
      .map((values) => [Math.min(...values), Math.max(...values)]);
    plan.step = niceStep(Math.max(...extent.map(([low, high]) => high - low)) / 16);
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
    const step =
      plan.extent && plan.step ? ` Lines every ${plainNumber(plan.step)}${data.unit ? ` ${data.unit}` : ""}.` : "";
    byId("m-plan-text").textContent = plan.extent
      ? `The plane from above, to scale.${options.grid ? step : ""}`
      : "The camera sees nothing of this plane.";
    if (plan.extent)
      drawPlan(
        planCanvas,
        plan,
        planPicture,
        sheet,
        cursor && pointAt(scene.map, cursor.pixel).point,
        data.unit,
        options.grid,
      );
  }
}

function renderPlan() {
  bytes ??= bytesOf(image);
  const layout = planLayout(plan, Math.max(planCanvas.clientWidth, 200));
  const shrink = Math.min(window.devicePixelRatio || 1, Math.sqrt(240000 / (layout.columns * layout.rows)));
  const [columns, rows] = [layout.columns, layout.rows].map((side) => Math.max(Math.round(side * shrink), 2));
  planPicture = document.createElement("canvas");
  [planPicture.width, planPicture.height] = [columns, rows];
  planPicture.getContext("2d").putImageData(pictureOf(plan, bytes, data.size, columns, rows), 0, 0);
}

// The sheet, the plane or the noise is another one.
function changed() {
  results = sheet.measures.map((measure) => ({
    quantities: quantitiesOf(scene, measure),
    measured: measure.points.map(({ pixel }) => {
      const found = measurePoint(scene, pixel);
      return { ...found, nonlinear: found.point !== null && isBent(scene, found) };
    }),
  }));
  overlay.texts = sheet.measures.map((measure, m) => {
    const [main] = results[m].quantities;
    return main && !Number.isNaN(main.value)
      ? withDeviation(main.value, main.deviation, unitOf(main.what, data.unit))
      : "";
  });
  fillAnswer(sheet, results, data.unit);
  fillMeasures(sheet, results, data.unit, actions);
  fillPoints(sheet, results, data.unit, actions);
  for (const button of document.querySelectorAll("[data-tool]"))
    button.setAttribute("aria-pressed", String(button.dataset.tool === sheet.tool));
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
    text = `pixel ${u}, ${v}: ${"xyz"
      .split("")
      .map((axis, i) => `${axis} ${withDeviation(measured.point[i], spread[i], "")}`)
      .join(", ")}${unit}`;
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
