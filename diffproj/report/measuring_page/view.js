// The photograph on its canvas: zoom, pan, the grid of the plane, hatching, measures, crosshair and loupe.
//
// Promises: coordinates are those of the original photograph, integer at pixel centres, whatever size is embedded; what
// has no point on the plane is darkened, what is extrapolated is hatched. It draws what it is told, and changes nothing.

const [LINE, CASING, CHOSEN] = ["#ffd84d", "rgba(0, 0, 0, 0.72)", "#ff5d8f"];

function makeView(canvas, image, size) {
  return { canvas, image, size, scale: 1, x: 0, y: 0, fitted: true };
}

// Pixels to places on the canvas in CSS px, and back. The photograph's edge lies half a pixel before its first centre.
const onCanvas = (view, [u, v]) => [(u + 0.5) * view.scale + view.x, (v + 0.5) * view.scale + view.y];
const toPixel = (view, [x, y]) => [(x - view.x) / view.scale - 0.5, (y - view.y) / view.scale - 0.5];

function fit(view) {
  const { clientWidth: w, clientHeight: h } = view.canvas;
  view.scale = Math.min(w / view.size[0], h / view.size[1]);
  view.x = (w - view.size[0] * view.scale) / 2;
  view.y = (h - view.size[1] * view.scale) / 2;
  view.fitted = true;
}

function zoom(view, factor, [x, y] = [view.canvas.clientWidth / 2, view.canvas.clientHeight / 2]) {
  const least = Math.min(view.canvas.clientWidth / view.size[0], view.canvas.clientHeight / view.size[1]) / 2;
  const scale = Math.min(Math.max(view.scale * factor, least), 80);
  const change = scale / view.scale;
  Object.assign(view, { scale, x: x - (x - view.x) * change, y: y - (y - view.y) * change, fitted: false });
}

function pan(view, dx, dy) {
  const [w, h] = view.size.map((side) => side * view.scale);
  const { clientWidth, clientHeight } = view.canvas;
  view.x = Math.min(Math.max(view.x + dx, 40 - w), clientWidth - 40);
  view.y = Math.min(Math.max(view.y + dy, 40 - h), clientHeight - 40);
  view.fitted = false;
}

// Move as little as it takes to have a pixel in sight.
function bringIntoSight(view, pixel) {
  const [x, y] = onCanvas(view, pixel);
  const { clientWidth: w, clientHeight: h } = view.canvas;
  const lack = (at, side) => (at < 24 ? 24 - at : at > side - 24 ? side - 24 - at : 0);
  const [dx, dy] = [lack(x, w), lack(y, h)];
  if (dx || dy) pan(view, dx, dy);
}

// ------------------------------------------------------------------------------------------------- what lies over it

// Where pixels see no point of the plane: cell by cell, each cut where its edges cross the limit, found by bisection.
function shadeOf(scene, [width, height]) {
  const [columns, rows] = [72, 54];
  const lost = ([x, y]) => pointAt(scene.map, [x - 0.5, y - 0.5]).point === null;
  const vertex = (row, column) => [(column * width) / columns, (row * height) / rows];
  const known = Array.from({ length: rows + 1 }, (_, row) =>
    Array.from({ length: columns + 1 }, (_, column) => lost(vertex(row, column))),
  );
  const crossing = (inside, outside) => {
    for (let round = 0; round < 8; round++) {
      const middle = [(inside[0] + outside[0]) / 2, (inside[1] + outside[1]) / 2];
      if (lost(middle)) inside = middle;
      else outside = middle;
    }
    return inside;
  };
  const nowhere = new Path2D();
  for (let row = 0; row < rows; row++) {
    for (let column = 0; column < columns; column++) {
      const corners = [
        [row, column],
        [row, column + 1],
        [row + 1, column + 1],
        [row + 1, column],
      ];
      const outline = corners.flatMap(([i, j], n) => {
        const [k, l] = corners[(n + 1) % 4];
        const [here, next] = [known[i][j], known[k][l]];
        const ends = [vertex(i, j), vertex(k, l)];
        const cut = here === next ? [] : [here ? crossing(ends[0], ends[1]) : crossing(ends[1], ends[0])];
        return here ? [ends[0], ...cut] : cut;
      });
      outline.forEach(([x, y], n) => nowhere[n ? "lineTo" : "moveTo"](x, y));
      if (outline.length) nowhere.closePath();
    }
  }
  return nowhere;
}

// The photograph without the region that the calibration's corners covered.
function outsideOf(region, [width, height]) {
  if (!region) return null;
  let corners = [
    [-1, -1],
    [1, -1],
    [1, 1],
    [-1, 1],
  ].map(([a, b]) => [a * 1e6, b * 1e6]);
  region.forEach((reach, k) => {
    const angle = (k * 2 * Math.PI) / region.length;
    const over = ([x, y]) => Math.cos(angle) * x + Math.sin(angle) * y - reach;
    corners = corners.flatMap((corner, n) => {
      const next = corners[(n + 1) % corners.length];
      const [a, b] = [over(corner), over(next)];
      const crossing = a < 0 !== b < 0 ? [corner.map((x, i) => x + ((next[i] - x) * a) / (a - b))] : [];
      return a <= 0 ? [corner, ...crossing] : crossing;
    });
  });
  const outside = new Path2D();
  outside.rect(0, 0, width, height);
  corners.forEach(([u, v], n) =>
    outside[n ? "lineTo" : "moveTo"](Math.min(Math.max(u + 0.5, 0), width), Math.min(Math.max(v + 0.5, 0), height)),
  );
  outside.closePath();
  return outside;
}

const niceStep = (about) => {
  const power = 10 ** Math.floor(Math.log10(about));
  return power * [1, 2, 5, 10].find((factor) => factor * power >= about * 0.999);
};

// Lines of the plane at whole steps, projected piece by piece.
function gridOf(scene, extent, step) {
  const { plane, camera } = scene.map;
  const place = (a, b) =>
    project(camera, plus(plus(times(plane.unit, plane.distance), plane.axes[0], a), plane.axes[1], b));
  const path = new Path2D();
  const [[lowA, highA], [lowB, highB]] = extent;
  const draw = (from, to, at) => {
    let drawn = false;
    for (let n = 0; n <= 96; n++) {
      const uv = at(from + ((to - from) * n) / 96);
      const seen = uv && Math.abs(uv[0]) < 1e6 && Math.abs(uv[1]) < 1e6;
      if (seen) path[drawn ? "lineTo" : "moveTo"](uv[0] + 0.5, uv[1] + 0.5);
      drawn = Boolean(seen);
    }
  };
  for (let a = Math.ceil(lowA / step) * step; a <= highA + 1e-9 * step; a += step)
    draw(lowB, highB, (b) => place(a, b));
  for (let b = Math.ceil(lowB / step) * step; b <= highB + 1e-9 * step; b += step)
    draw(lowA, highA, (a) => place(a, b));
  return path;
}

function hatching(context, ratio) {
  const tile = document.createElement("canvas");
  tile.width = tile.height = Math.round(12 * ratio);
  const pen = tile.getContext("2d");
  const side = tile.width;
  for (const [color, shift] of [
    ["rgba(0, 0, 0, 0.32)", 1.2 * ratio],
    ["rgba(255, 255, 255, 0.42)", 0],
  ]) {
    pen.strokeStyle = color;
    pen.lineWidth = ratio;
    for (const offset of [-side, 0, side]) {
      pen.beginPath();
      pen.moveTo(offset + shift, side);
      pen.lineTo(offset + side + shift, 0);
      pen.stroke();
    }
  }
  const pattern = context.createPattern(tile, "repeat");
  pattern.setTransform(new DOMMatrix().scale(1 / ratio));
  return pattern;
}

// ----------------------------------------------------------------------------------------------------------- drawing

function prepared(canvas, width, height) {
  const ratio = window.devicePixelRatio || 1;
  const [w, h] = [Math.round(width * ratio), Math.round(height * ratio)];
  if (canvas.width !== w || canvas.height !== h) [canvas.width, canvas.height] = [w, h];
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  return { context, ratio };
}

function drawPhotograph(context, view, scale = view.scale) {
  context.imageSmoothingEnabled = scale < 3;
  context.imageSmoothingQuality = "high";
  context.drawImage(view.image, 0, 0, ...view.size);
}

function drawView(view, sheet, overlay, cursor, options) {
  const { clientWidth: width, clientHeight: height } = view.canvas;
  const { context, ratio } = prepared(view.canvas, width, height);
  context.save();
  context.translate(view.x, view.y);
  context.scale(view.scale, view.scale);
  drawPhotograph(context, view);
  context.beginPath();
  context.rect(0, 0, ...view.size);
  context.clip();
  if (options.grid && overlay.grid) {
    for (const [color, width] of [
      ["rgba(0, 0, 0, 0.35)", 2.2],
      ["rgba(255, 255, 255, 0.75)", 0.9],
    ]) {
      context.strokeStyle = color;
      context.lineWidth = width / view.scale;
      context.stroke(overlay.grid);
    }
  }
  context.fillStyle = "rgba(12, 14, 20, 0.62)";
  context.fill(overlay.nowhere);
  context.restore();
  if (overlay.outside) {
    context.save();
    const path = new Path2D();
    path.addPath(overlay.outside, new DOMMatrix([view.scale, 0, 0, view.scale, view.x, view.y]));
    context.fillStyle = hatching(context, ratio);
    context.fill(path, "evenodd");
    context.restore();
  }
  for (const [m, measure] of sheet.measures.entries())
    drawMeasure(context, view, sheet, measure, m, overlay.texts[m] ?? "");
  if (cursor) {
    drawCross(context, onCanvas(view, cursor.pixel), options.keyboard ? 14 : 9);
    if (options.loupe && !cursor.touch) drawLoupe(context, view, cursor.pixel, width, height);
  }
}

function stroke(context, draw, color = LINE, width = 2) {
  for (const [ink, thick] of [
    [CASING, width + 2.4],
    [color, width],
  ]) {
    context.strokeStyle = ink;
    context.lineWidth = thick;
    context.lineJoin = context.lineCap = "round";
    context.beginPath();
    draw();
    context.stroke();
  }
}

function drawMeasure(context, view, sheet, measure, number, text) {
  const places = measure.points.map(({ pixel }) => onCanvas(view, pixel));
  if (places.length > 1) {
    const outline = () => {
      places.forEach(([x, y], n) => context[n ? "lineTo" : "moveTo"](x, y));
      if (measure.kind === "area" && places.length > 2) context.closePath();
    };
    if (measure.kind === "area" && places.length > 2) {
      context.beginPath();
      outline();
      context.fillStyle = "rgba(255, 216, 77, 0.22)";
      context.fill();
    }
    stroke(context, outline);
  }
  places.forEach(([x, y], n) => {
    const chosen = sheet.chosen?.measure === number && sheet.chosen?.point === n;
    stroke(
      context,
      () => context.arc(x, y, chosen ? 8 : 5.5, 0, 2 * Math.PI),
      chosen ? CHOSEN : LINE,
      chosen ? 2.4 : 1.8,
    );
    context.fillStyle = chosen ? CHOSEN : LINE;
    context.fillRect(x - 0.75, y - 0.75, 1.5, 1.5);
    label(context, measure.points[n].name, x + 11, y - 11, "left", 12);
  });
  if (text && places.length) {
    let [x, y] = [0, 1].map((axis) => sum(places.map((place) => place[axis])) / places.length);
    if (measure.kind === "length") y += 17;
    if (measure.kind === "angle") {
      const [dx, dy] = [places[1][0] - x, places[1][1] - y]; // beyond the corner, where no arm is
      const away = Math.max(hypot(dx, dy), 1);
      [x, y] = [places[1][0] + (dx / away) * 54, places[1][1] + (dy / away) * 30];
    }
    label(context, text, x, y, "center", 14, true);
  }
}

function label(context, text, x, y, align, size, pill = false) {
  const shown = text.length > 48 ? `${text.slice(0, 47)}…` : text;
  context.font = `600 ${size}px ${getComputedStyle(document.body).fontFamily}`;
  context.textAlign = align;
  context.textBaseline = "middle";
  if (pill) {
    const width = context.measureText(shown).width + 14;
    context.fillStyle = "rgba(12, 14, 20, 0.82)";
    context.beginPath();
    context.roundRect(x - width / 2, y - size * 0.85, width, size * 1.7, 6);
    context.fill();
    context.fillStyle = "#ffffff";
    context.fillText(shown, x, y + 0.5);
    return;
  }
  context.lineWidth = 3.4;
  context.lineJoin = "round";
  context.strokeStyle = CASING;
  context.strokeText(shown, x, y);
  context.fillStyle = "#ffffff";
  context.fillText(shown, x, y);
}

function drawCross(context, [x, y], arm) {
  const gap = 3;
  stroke(
    context,
    () => {
      for (const [dx, dy] of [
        [1, 0],
        [-1, 0],
        [0, 1],
        [0, -1],
      ]) {
        context.moveTo(x + dx * gap, y + dy * gap);
        context.lineTo(x + dx * arm, y + dy * arm);
      }
    },
    "#ffffff",
    1.3,
  );
}

// The photograph around the cursor, larger, in the corner that the cursor is not in.
function drawLoupe(context, view, pixel, width, height) {
  const radius = Math.min(74, width / 7, height / 5);
  const [x, y] = onCanvas(view, pixel);
  const margin = radius + 12;
  const near = x > width - 2.6 * margin && y < 2.6 * margin;
  const [cx, cy] = [near ? margin : width - margin, margin];
  const scale = Math.max(9, 4 * view.scale);
  context.save();
  context.beginPath();
  context.arc(cx, cy, radius, 0, 2 * Math.PI);
  context.fillStyle = "#101318";
  context.fill();
  context.clip();
  context.translate(cx - (pixel[0] + 0.5) * scale, cy - (pixel[1] + 0.5) * scale);
  context.scale(scale, scale);
  drawPhotograph(context, view, scale);
  context.restore();
  stroke(context, () => context.arc(cx, cy, radius, 0, 2 * Math.PI), "#ffffff", 2);
  drawCross(context, [cx, cy], radius * 0.45);
}
