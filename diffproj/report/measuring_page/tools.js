// What is measured: points in measures, the choice among them, undo, names, and the numbers in words and as tables.
//
// Promises: every change can be undone; a finished measure always has as many points as it needs; texts round values as
// the library does, to the second digit of their deviation. Nothing here touches the page.

const NEEDED = { point: 1, length: 2, angle: 3, area: 3 };
const TITLES = { point: "Point", length: "Length", angle: "Angle", area: "Area" };

function makeSheet() {
  return {
    measures: [],
    tool: "length",
    prompted: false,
    chosen: null,
    past: [],
    future: [],
    counts: { point: 0, length: 0, angle: 0, area: 0 },
  };
}

function remember(sheet) {
  sheet.past.push(JSON.stringify([sheet.measures, sheet.counts]));
  sheet.future = [];
}

function stepBack(sheet, from, to) {
  if (!sheet[from].length) return false;
  sheet[to].push(JSON.stringify([sheet.measures, sheet.counts]));
  [sheet.measures, sheet.counts] = JSON.parse(sheet[from].pop());
  sheet.chosen = null;
  return true;
}
const undo = (sheet) => stepBack(sheet, "past", "future");
const redo = (sheet) => stepBack(sheet, "future", "past");

const isComplete = ({ kind, points }) => points.length >= NEEDED[kind];
const openMeasure = (sheet) => sheet.measures.find(({ open }) => open);

// Put a point: into the measure that still wants one, or as the first of a new one.
function putPoint(sheet, pixel) {
  remember(sheet);
  sheet.prompted = false;
  let measure = openMeasure(sheet);
  if (!measure) {
    const number = ++sheet.counts[sheet.tool];
    measure = { kind: sheet.tool, name: `${TITLES[sheet.tool]} ${number}`, points: [], open: true };
    sheet.measures.push(measure);
  }
  measure.points.push({ pixel, name: nextLetter(sheet) });
  if (measure.kind !== "area" && isComplete(measure)) measure.open = false;
  sheet.chosen = { measure: sheet.measures.indexOf(measure), point: measure.points.length - 1 };
  return measure;
}

// A, B, ... Z, A2, B2, ...: the first that no point has.
function nextLetter(sheet) {
  const taken = new Set(sheet.measures.flatMap(({ points }) => points.map(({ name }) => name)));
  for (let n = 0; ; n++) {
    const name = String.fromCharCode(65 + (n % 26)) + (n < 26 ? "" : Math.floor(n / 26) + 1);
    if (!taken.has(name)) return name;
  }
}

// End what is open: kept where it has all its points, else forgotten.
function finish(sheet) {
  const measure = openMeasure(sheet);
  if (!measure) return;
  remember(sheet);
  measure.open = false;
  if (!isComplete(measure)) sheet.measures.splice(sheet.measures.indexOf(measure), 1);
  sheet.chosen = null;
}

// From now on points make measures of this kind; the answer says what it wants.
function chooseTool(sheet, tool) {
  if (openMeasure(sheet)) finish(sheet);
  Object.assign(sheet, { tool, chosen: null, prompted: true });
}

// A corner of an area goes alone as long as three are left; every other point takes its measure along.
function deletePoint(sheet, { measure: m, point }) {
  remember(sheet);
  const measure = sheet.measures[m];
  const spare = measure.kind === "area" ? measure.points.length > 3 : false;
  if (spare || (measure.open && measure.points.length > 1)) measure.points.splice(point, 1);
  else sheet.measures.splice(m, 1);
  sheet.chosen = null;
}

function deleteMeasure(sheet, m) {
  remember(sheet);
  sheet.measures.splice(m, 1);
  sheet.chosen = null;
}

function chosenPoint(sheet) {
  return sheet.chosen && sheet.measures[sheet.chosen.measure]?.points[sheet.chosen.point];
}

function chooseNext(sheet, side) {
  const all = sheet.measures.flatMap(({ points }, measure) => points.map((_, point) => ({ measure, point })));
  if (!all.length) return;
  const now = all.findIndex(({ measure, point }) => measure === sheet.chosen?.measure && point === sheet.chosen?.point);
  sheet.chosen = all[now < 0 ? (side > 0 ? 0 : all.length - 1) : (now + side + all.length) % all.length];
}

// The quantities of a measure, the one that matters first.
function quantitiesOf(scene, measure) {
  const points = measure.points.map(({ pixel }) => measurePoint(scene, pixel));
  if (measure.kind === "length" && points.length === 2) return [{ what: "length", ...measureLength(scene, points) }];
  if (measure.kind === "angle" && points.length === 3)
    return [{ what: "angle", ...inDegrees(measureAngle(scene, points)) }];
  if (measure.kind === "area" && points.length > 2) {
    return [
      { what: "area", ...measureArea(scene, points) },
      { what: "perimeter", ...measurePerimeter(scene, points) },
    ];
  }
  return [];
}

function inDegrees(found) {
  const parts = ["value", "deviation", "low", "high"].map((name) => [name, (found[name] * 180) / Math.PI]);
  return { ...found, ...Object.fromEntries(parts) };
}

// ------------------------------------------------------------------------------------------------------------ in words

function decimalsOf(deviation) {
  return Math.min(Math.max(0, 1 - Math.floor(Math.log10(deviation))), 15);
}

const plainNumber = (value) => String(Number(value.toPrecision(6))).replace("-", "−");

function rounded(value, deviation) {
  if (!Number.isFinite(value)) return value > 0 ? "∞" : "−∞";
  if (!(Number.isFinite(deviation) && deviation > 0)) return plainNumber(value);
  if (deviation >= 1e5) return value.toExponential(2).replaceAll("-", "−");
  return value
    .toFixed(decimalsOf(deviation))
    .replace(/^-(?=[0.]*$)/, "")
    .replace("-", "−");
}

function withDeviation(value, deviation, unit) {
  const tail = unit ? (unit === "°" ? unit : ` ${unit}`) : "";
  if (Number.isNaN(value)) return "–";
  if (deviation === Infinity) return `${plainNumber(value)}${tail}, not determined`;
  if (!(deviation > 0)) return `${plainNumber(value)}${tail}`;
  const spread = deviation >= 1e5 ? deviation.toExponential(1) : deviation.toFixed(decimalsOf(deviation));
  return `${rounded(value, deviation)} ± ${spread}${tail}`;
}

function intervalText({ value, deviation, low, high }, unit) {
  if (Number.isNaN(value)) return "";
  const tail = unit ? (unit === "°" ? unit : ` ${unit}`) : "";
  if (high === Infinity) return low > 0 ? `more than ${rounded(low, deviation)}${tail}` : "anything";
  return `${rounded(low, deviation)} to ${rounded(high, deviation)}${tail}`;
}

function unitOf(what, unit) {
  if (what === "angle") return "°";
  if (!unit) return what === "area" ? "units²" : "units";
  return what === "area" ? `${unit}²` : unit;
}

function remarksOf(measured, quantities = []) {
  const remarks = [];
  const lost = measured.find(({ point }) => point === null);
  if (lost) remarks.push(REASONS[lost.reason]);
  if (measured.some(({ point, extrapolated }) => point !== null && extrapolated))
    remarks.push("extrapolated: the calibration saw no corner there");
  if (quantities.some(({ nonlinear }) => nonlinear)) remarks.push("lopsided: its deviation misleads");
  return remarks.join("; ");
}

// ---------------------------------------------------------------------------------------------------------- as a table

const finite = (x) => (Number.isFinite(x) ? x : null);

function asDocument(sheet, scene, context) {
  const measures = sheet.measures.map((measure) => {
    const measured = measure.points.map(({ pixel }) => measurePoint(scene, pixel));
    const points = measure.points.map(({ name, pixel: [u, v] }, n) => {
      const { point, reason, extrapolated = false } = measured[n];
      const places = Object.fromEntries("xyz".split("").map((axis, i) => [axis, point && point[i]]));
      const spread = point ? deviationsOf(measured[n]) : [null, null, null];
      const deviations = Object.fromEntries("xyz".split("").map((axis, i) => [`${axis}_deviation`, finite(spread[i])]));
      return { name, u, v, ...places, ...deviations, extrapolated, remark: REASONS[reason] };
    });
    const found = quantitiesOf(scene, measure).map(({ what, value, deviation, low, high }) => ({
      what,
      value: finite(value),
      deviation: finite(deviation),
      low_95: finite(low),
      high_95: finite(high),
      unit: unitOf(what, context.unit),
    }));
    return { name: measure.name, kind: measure.kind, quantities: found, points };
  });
  return { ...context, measures };
}

// A cell that a spreadsheet would take for a formula is set in quotes of its own.
function cell(value) {
  if (value === null || value === undefined) return "";
  const text = typeof value === "string" && /^[=+\-@\t\r]/.test(value) ? `'${value}` : String(value);
  return /[",\r\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
}

function asTable({ measures, unit }) {
  const title = [
    "measure",
    "row",
    "value",
    "deviation",
    "low_95",
    "high_95",
    "unit",
    "u",
    "v",
    "x",
    "y",
    "z",
    "x_deviation",
    "y_deviation",
    "z_deviation",
    "extrapolated",
    "remark",
  ];
  const rows = measures.flatMap(({ name, quantities, points }) => [
    ...quantities.map((q) => [name, q.what, q.value, q.deviation, q.low_95, q.high_95, q.unit]),
    ...points.map((p) => [
      name,
      p.name,
      "",
      "",
      "",
      "",
      unit ?? "",
      p.u,
      p.v,
      p.x,
      p.y,
      p.z,
      p.x_deviation,
      p.y_deviation,
      p.z_deviation,
      p.extrapolated,
      p.remark,
    ]),
  ]);
  const full = rows.map((row) => [...row, ...new Array(title.length - row.length).fill("")]);
  return `${[title, ...full].map((row) => row.map(cell).join(",")).join("\r\n")}\r\n`;
}
