// The plane from above: the photograph laid onto it, to scale, with the grid and what was measured.
//
// Promises: it is not mirrored, as seen from the camera's side; what the camera does not see, or sees beyond its lens's
// domain, stays empty. The axis of the plane that runs to the right is the one that runs most to the right in the picture.

function makePlan(scene, size, others = []) {
  const { plane, camera } = scene.map;
  const [x, y] = plane.axes;
  const aside = [x, y].map((axis) => dot(axis, camera.R[0]));
  const along = Math.abs(aside[0]) >= Math.abs(aside[1]) ? 0 : 1;
  const right = times(plane.axes[along], Math.sign(aside[along]) || 1);
  const towards = dot(plane.unit, camera.place) >= plane.distance ? plane.unit : times(plane.unit, -1);
  const up = cross(towards, right);
  const origin = times(plane.unit, plane.distance);
  const plan = { scene, right, up, origin };
  plan.extent = extentOf(plan, size, others);
  return plan;
}

const inPlan = (plan, point) => [dot(point, plan.right), dot(point, plan.up)];
const fromPlan = (plan, a, b) => plus(plus(plan.origin, plan.right, a), plan.up, b);

// What is worth seeing: all that the photograph shows of the plane, up to where a pixel covers six times as much of it
// as in its best places.
function extentOf(plan, [width, height], others) {
  const { map } = plan.scene;
  const seen = [];
  for (let row = 0; row <= 24; row++) {
    for (let column = 0; column <= 32; column++) {
      const pixel = [(column / 32) * width - 0.5, (row / 24) * height - 0.5];
      const { point } = pointAt(map, pixel);
      if (point === null) continue;
      const { byPixel } = stretchAt(map, point);
      seen.push({ place: inPlan(plan, point), coarse: Math.hypot(...byPixel.flat()) });
    }
  }
  if (!seen.length) return null;
  const sorted = seen.map(({ coarse }) => coarse).sort((a, b) => a - b);
  const limit = 6 * sorted[Math.floor(sorted.length / 20)];
  const kept = seen.filter(({ coarse }) => coarse <= limit).map(({ place }) => place);
  kept.push(...others.map((point) => inPlan(plan, point)));
  return [0, 1].map((axis) => {
    const values = kept.map((place) => place[axis]);
    const [low, high] = [Math.min(...values), Math.max(...values)];
    return [low, high + (high === low ? 1 : 0)];
  });
}

// The photograph's bytes, for looking up its colours.
function bytesOf(image) {
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [image.naturalWidth, image.naturalHeight];
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.drawImage(image, 0, 0);
  return context.getImageData(0, 0, canvas.width, canvas.height);
}

// The rectified picture, of so many columns and rows.
function pictureOf(plan, bytes, [width, height], columns, rows) {
  const picture = new ImageData(columns, rows);
  const [[low, right], [bottom, high]] = plan.extent;
  const [sx, sy] = [bytes.width / width, bytes.height / height];
  const { camera } = plan.scene.map;
  for (let row = 0; row < rows; row++) {
    const b = high - ((row + 0.5) / rows) * (high - bottom);
    for (let column = 0; column < columns; column++) {
      const uv = project(camera, fromPlan(plan, low + ((column + 0.5) / columns) * (right - low), b));
      if (uv === null) continue;
      const [u, v] = [(uv[0] + 0.5) * sx - 0.5, (uv[1] + 0.5) * sy - 0.5];
      if (!(u > -0.5 && v > -0.5 && u < bytes.width - 0.5 && v < bytes.height - 0.5)) continue;
      blend(bytes, u, v, picture.data, 4 * (row * columns + column));
    }
  }
  return picture;
}

function blend({ data, width, height }, u, v, target, at) {
  const [x, y] = [Math.min(Math.max(u, 0), width - 1), Math.min(Math.max(v, 0), height - 1)];
  const [i, j] = [Math.min(Math.floor(x), width - 2), Math.min(Math.floor(y), height - 2)];
  const [a, b] = [x - i, y - j];
  const from = 4 * (j * width + i);
  for (let channel = 0; channel < 3; channel++) {
    const k = from + channel;
    const [top, bottom] = [
      data[k] * (1 - a) + data[k + 4] * a,
      data[k + 4 * width] * (1 - a) + data[k + 4 * width + 4] * a,
    ];
    target[at + channel] = top * (1 - b) + bottom * b;
  }
  target[at + 3] = 255;
}

function planLayout(plan, width) {
  const [[low, right], [bottom, high]] = plan.extent;
  const shape = Math.min(Math.max((high - bottom) / (right - low), 0.45), 1.25);
  const height = Math.round(width * shape);
  const scale = Math.min(width / (right - low), height / (high - bottom));
  const [x, y] = [(width - (right - low) * scale) / 2, (height - (high - bottom) * scale) / 2];
  const place = (point) => {
    const [a, b] = inPlan(plan, point);
    return [x + (a - low) * scale, y + (high - b) * scale];
  };
  return { width, height, scale, x, y, place, columns: (right - low) * scale, rows: (high - bottom) * scale };
}

function drawPlan(canvas, plan, picture, sheet, cursorPoint, unit, showGrid) {
  const layout = planLayout(plan, canvas.clientWidth);
  canvas.style.height = `${layout.height}px`;
  const { context } = prepared(canvas, layout.width, layout.height);
  if (picture) {
    context.imageSmoothingQuality = "high";
    context.drawImage(picture, layout.x, layout.y, layout.columns, layout.rows);
  }
  if (showGrid) drawPlanGrid(context, plan, layout);
  const { map } = plan.scene;
  for (const measure of sheet.measures) {
    const places = measure.points
      .map(({ pixel }) => pointAt(map, pixel).point)
      .filter(Boolean)
      .map(layout.place);
    const outline = () => {
      places.forEach(([x, y], n) => context[n ? "lineTo" : "moveTo"](x, y));
      if (measure.kind === "area" && places.length > 2) context.closePath();
    };
    if (places.length > 1) stroke(context, outline, LINE, 1.6);
    for (const [x, y] of places) stroke(context, () => context.arc(x, y, 2.6, 0, 2 * Math.PI), LINE, 1.4);
  }
  if (cursorPoint) drawCross(context, layout.place(cursorPoint), 8);
  drawScaleBar(context, layout, unit);
}

function drawPlanGrid(context, plan, layout) {
  const step = plan.step;
  const [[low, right], [bottom, high]] = plan.extent;
  context.strokeStyle = "rgba(255, 255, 255, 0.5)";
  context.lineWidth = 0.7;
  context.beginPath();
  for (let a = Math.ceil(low / step) * step; a <= right; a += step) {
    const x = layout.x + (a - low) * layout.scale;
    context.moveTo(x, layout.y);
    context.lineTo(x, layout.y + layout.rows);
  }
  for (let b = Math.ceil(bottom / step) * step; b <= high; b += step) {
    const y = layout.y + (high - b) * layout.scale;
    context.moveTo(layout.x, y);
    context.lineTo(layout.x + layout.columns, y);
  }
  context.stroke();
}

function drawScaleBar(context, layout, unit) {
  const length = niceStep(layout.width / 7 / layout.scale);
  const long = length * layout.scale;
  const [x, y] = [12, layout.height - 14];
  stroke(
    context,
    () => {
      context.moveTo(x, y - 4);
      context.lineTo(x, y);
      context.lineTo(x + long, y);
      context.lineTo(x + long, y - 4);
    },
    "#ffffff",
    1.6,
  );
  label(context, `${plainNumber(length)}${unit ? ` ${unit}` : ""}`, x + long + 9, y - 4, "left", 12);
}
