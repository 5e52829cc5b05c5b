// Points, lengths, areas and angles with their error bars, as the library's `measure` gives them.
//
// Promises: deviations and 95 % intervals of what is measured from points that share the errors of the camera, its lens
// and its pose, and have those of their own pixels. Intervals follow the curve from the pixels to the plane: near the
// horizon they are lopsided, and open where the errors reach it. What the calibration does not determine is infinite.

// The shared errors: independent ones of deviation 1, of which `root` makes those of the q parameters; then that the
// pose may be the wrong one of two. A point's `lost` are its steps by what is not determined at all; a point that is
// `nowhere` may be anywhere.
function makeKnowledge(description, map) {
  const { root, undetermined, middle, skew, moved, region, other } = description;
  const q = root.length;
  const knowledge = {
    q,
    root,
    columns: q ? transposed(root) : [],
    middle,
    skew,
    knows: q > 0,
    region,
    freedom: description.freedom ?? Infinity,
  };
  knowledge.undetermined = undetermined;
  knowledge.moved = moved.map((camera) => makeMap(makeCamera(camera), map.plane));
  knowledge.other = other && { ...other, map: makeMap(makeCamera({ ...description.camera, ...other }), map.plane) };
  return knowledge;
}

function isCovered([u, v], region) {
  return region.every((reach, k) => {
    const angle = (k * 2 * Math.PI) / region.length;
    return Math.cos(angle) * u + Math.sin(angle) * v <= reach;
  });
}

// How many times as uncertain a point is as to first order where the lens is extrapolated; infinite where it may end.
function extrapolation(knowledge, pixel, point, moves) {
  let total = 0;
  for (const [number, map] of knowledge.moved.entries()) {
    const straight = 9 * sum(moves[number % moves.length].map((x) => x * x));
    const again = pointAt(map, pixel);
    if (again.reason === "lens") return Infinity;
    const off = again.point && minus(again.point, point);
    total += off ? dot(off, off) : straight;
  }
  const first = sum(moves.flat().map((x) => x * x));
  return first > 0 ? Math.sqrt(Math.max(total / 18 / first, 1)) : 1;
}

// A measured pixel: where it lies on the plane, and how that follows each error of deviation 1: 3 x (shared + 2).
function measurePoint(scene, pixel) {
  const { map, knowledge, sigma } = scene;
  const { point, reason } = pointAt(map, pixel);
  if (point === null) return { pixel, point, reason };
  const { byPixel, byTheta } = slopesAt(map, pixel, point, knowledge);
  const along = knowledge.columns.map((column) => byTheta.map((row) => row.reduce((t, x, i) => t + x * column[i], 0)));
  const moves = along.map(([du, dv]) => byPixel.map((row) => -(row[0] * du + row[1] * dv)));
  const extrapolated = knowledge.region !== null && !isCovered(pixel, knowledge.region);
  const factor = extrapolated && knowledge.knows ? extrapolation(knowledge, pixel, point, moves) : 1;
  const wider = factor === Infinity ? 1 : factor;
  const shared = moves.map((move) => times(move, wider));
  const away = [];
  const lost = knowledge.undetermined.map((index) =>
    byPixel.map((row) => row[0] * byTheta[0][index] + row[1] * byTheta[1][index]),
  );
  let nowhere = factor === Infinity;
  if (knowledge.other) {
    const there = pointAt(knowledge.other.map, pixel).point;
    away.push(there ? times(minus(there, point), Math.sqrt(knowledge.other.probability)) : [0, 0, 0]);
    nowhere ||= !there && knowledge.other.ambiguous;
  }
  const own = [0, 1].map((axis) => byPixel.map((row) => row[axis] * sigma));
  const sway = along.map((step) => step.map((part) => part * wider));
  return { pixel, point, reason, extrapolated, lost, nowhere, shared: [...shared, ...away], own, sway, away };
}

// Where a point comes to lie, and its slopes, when all errors are what is given, in deviations.
function shaken(scene, measured, errors, own) {
  const { map, knowledge, sigma } = scene;
  const { q } = knowledge;
  const pixel = measured.pixel.map(
    (x, axis) => x + sigma * own[axis] - measured.sway.reduce((t, step, e) => t + step[axis] * errors[e], 0),
  );
  const { point } = pointAt(map, pixel);
  if (point === null) return null;
  const { byPixel } = stretchAt(map, point);
  const place = measured.away.reduce((place, away, n) => plus(place, away, errors[q + n]), point);
  const shared = measured.sway.map((step) => byPixel.map((row) => -(row[0] * step[0] + row[1] * step[1])));
  return {
    point: place,
    shared: [...shared, ...measured.away],
    own: [0, 1].map((axis) => byPixel.map((row) => row[axis] * sigma)),
  };
}

// ---------------------------------------------------------------------------------------------- vectors of the points

// Each gives a vector of k points, whose length is what is asked, with its slopes by the points: slopes[j] maps a step of
// point j to one of the vector; and whether the length is what the angle lacks to 180 degrees.

function difference([a, b]) {
  return { w: minus(b, a), along: [(step) => times(step, -1), (step) => step], supplement: false };
}

function areaVector(points) {
  const start = points[0];
  const at = (n) => minus(points[(n + points.length) % points.length], start);
  let w = [0, 0, 0];
  for (let n = 0; n < points.length; n++) w = plus(w, cross(at(n), at(n + 1)), 0.5);
  const along = points.map((_, n) => (step) => times(cross(step, minus(at(n + 1), at(n - 1))), 0.5));
  return { w, along, supplement: false };
}

function turn([first, corner, last]) {
  const [a, b] = [minus(first, corner), minus(last, corner)];
  const [across, inner] = [cross(a, b), dot(a, b)];
  const [sine, cosine, sign] = [norm(across), Math.abs(inner), inner < 0 ? -1 : 1];
  const size = sine * sine + cosine * cosine;
  const q = cosine > 0 ? sine / cosine : Infinity;
  const g = sine > 0 ? Math.atan2(sine, cosine) / sine : cosine > 0 ? 1 / cosine : 0;
  // (dg / dsine) / sine; by its series where the two terms cancel.
  const bend = !(size > 0)
    ? 0
    : q < 0.01
      ? (-2 / 3 + q * q * (4 / 5 - (6 / 7) * q * q)) / cosine ** 3
      : (cosine / size - g) / (sine * sine);
  const byArms = (da, db) => {
    const turned = plus(cross(da, b), cross(a, db));
    const opened = sign * (dot(da, b) + dot(a, db));
    return plus(times(turned, g), across, bend * dot(across, turned) - opened / (size || 1));
  };
  const none = [0, 0, 0];
  const along = [(d) => byArms(d, none), (d) => byArms(times(d, -1), times(d, -1)), (d) => byArms(none, d)];
  return { w: times(across, g), along, supplement: inner < 0 };
}

// ------------------------------------------------------------------------------------------------ quantities of points

const UNKNOWN = { value: NaN, deviation: NaN, low: NaN, high: NaN };

// All errors of k points in one list: the shared ones, then two for each point. `columns[e]` is the vector's step.
function columnsOf(steps, along, size) {
  const shared = steps[0].shared.map((_, e) => {
    let total = new Array(size).fill(0);
    for (const [j, step] of steps.entries()) total = total.map((x, i) => x + along[j](step.shared[e])[i]);
    return total;
  });
  return [...shared, ...steps.flatMap((step, j) => step.own.map((own) => along[j](own)))];
}

// Whether a component of the vector depends on what nobody knows.
function isLost(points, along) {
  if (points.some(({ nowhere }) => nowhere)) return true;
  return points[0].lost.some((_, n) => sum(points.map(({ lost }, j) => along(j, lost[n]))) !== 0);
}

function freedomOf(scene, rows, count) {
  const { knowledge } = scene;
  const square = (some) => sum(some.map((x) => x * x));
  const pixels = square(rows.slice(rows.length - 2 * count));
  const shaky = square(rows.slice(0, knowledge.q)) + (scene.pixelsToo ? pixels : 0);
  const total = square(rows);
  const share = total > 0 ? shaky / total : 1;
  return share > 0 ? knowledge.freedom / Math.max(share * share, 1e-300) : Infinity;
}

// The length of the vector, or pi less than that: value, deviation, 95 % interval.
function measureNorm(scene, points, vector, limit = Infinity) {
  if (points.some(({ point }) => point === null)) return UNKNOWN;
  const found = vector(points.map(({ point }) => point));
  const columns = columnsOf(points, found.along, 3);
  const C = [0, 1, 2].map((i) => [0, 1, 2].map((j) => sum(columns.map((column) => column[i] * column[j]))));
  const r = norm(found.w);
  const value = found.supplement ? limit - r : r;
  const u = r > 0 ? times(found.w, 1 / r) : [0, 0, 0];
  const along = dot(u, apply(C, u));
  const across = C[0][0] + C[1][1] + C[2][2] - along;
  const variance = along + (across > 0 ? across * Math.exp((-r * r) / across) : 0);
  const longest = longestAxis(C);
  const towards = r > 0 ? u : longest.axis;
  const lost = isLost(points, (j, step) => dot(towards, found.along[j](step)));
  const reach = studentReach(
    freedomOf(
      scene,
      columns.map((column) => dot(column, towards)),
      points.length,
    ),
  );
  const deviation = lost ? Infinity : variance > 0 ? Math.sqrt(variance) : 0;
  const bounds = lost
    ? { low: 0, high: limit }
    : normBounds(scene, points, vector, { found, C, r, longest, reach, limit });
  return described({ value, deviation, ...bounds, reach });
}

function normBounds(scene, points, vector, { found, C, r, longest, reach, limit }) {
  const z = NORMAL_REACH;
  const tiny = r <= 1e-9 * Math.sqrt(longest.largest);
  const u = tiny ? longest.axis : times(found.w, 1 / r);
  const Cu = apply(C, u);
  const along = Math.max(dot(u, Cu), 0);
  const s = Math.sqrt(along);
  const unit = s > 0 ? s : 1;
  const across = Math.max(C[0][0] + C[1][1] + C[2][2] - along, 0) / unit ** 2;
  const off = plus(Cu, u, -along);
  const correlated = dot(off, off) / unit ** 4;
  const signed = (places) => {
    const there = vector(places);
    const size = norm(there.w);
    const inner = dot(u, there.w);
    if (there.supplement === found.supplement || limit === Infinity) {
      return { value: inner, gradient: (j, step) => dot(u, there.along[j](step)) };
    }
    const beyond = limit / (size || 1) - 1;
    const gradient = (j, step) => {
      const moved = there.along[j](step);
      return dot(u, moved) * beyond - ((inner * limit) / (size || 1) ** 3) * dot(there.w, moved);
    };
    return { value: inner * beyond, gradient };
  };
  const slopes = columnsOf(points, found.along, 3).map((column) => dot(u, column));
  const down = extreme(scene, points, signed, r, slopes, -1, reach);
  const up = extreme(scene, points, signed, r, slopes, 1, reach);
  const after = (steps) => {
    const at = allShaken(
      scene,
      points,
      down.where.map((part) => (part * steps * reach) / z),
    );
    return at ? signed(at.map(({ point }) => point)).value : -Infinity;
  };
  const toZero = stepsToZero(after, r);
  let low = down.best;
  if (toZero < FAR && s > 0) {
    const inner = lowerBound(toZero, across, correlated, longest.largest / unit ** 2);
    const shorter = inner > 0 ? after(toZero - inner) : 0;
    low = Number.isFinite(shorter) ? shorter : 0;
  }
  low = Math.max(low, 0);
  const step = s > 0 ? Math.max((up.best - r) / (z * unit), 0) : Math.max(reach / z, 0);
  const wide = Number.isFinite(step) ? step ** 2 : 1;
  const wider = { largest: longest.largest * wide, axis: longest.axis };
  let high =
    up.best === Infinity
      ? Infinity
      : upperBound(
          found.w,
          C.map((row) => times(row, wide)),
          wider,
        );
  if (found.supplement) [low, high] = [limit - high, limit - low];
  return { low: Math.max(low, 0), high: Math.min(high, limit) };
}

function allShaken(scene, points, errors) {
  const count = errors.length - 2 * points.length;
  const found = points.map((point, j) => shaken(scene, point, errors, errors.slice(count + 2 * j, count + 2 * j + 2)));
  return found.includes(null) ? null : found;
}

// The largest value (side 1) or the smallest (-1) within reach of all errors, and in which direction it lies.
function extreme(scene, points, valueOf, value, slopes, side, reach) {
  const towards = (rows) => {
    const size = Math.hypot(...rows);
    return rows.map((row) => (size > 0 ? (side * row) / size : 0));
  };
  let [best, direction] = [value, towards(slopes)];
  let where = direction;
  for (let round = 0; round < 8; round++) {
    const at = allShaken(
      scene,
      points,
      direction.map((part) => part * reach),
    );
    if (at === null) return { best: side * Infinity, where };
    const there = valueOf(at.map(({ point }) => point));
    if (side * there.value > side * best) [best, where] = [there.value, direction];
    const shared = slopes.slice(0, slopes.length - 2 * points.length);
    const slope = [
      ...shared.map((_, e) => sum(at.map((step, j) => there.gradient(j, step.shared[e])))),
      ...at.flatMap((step, j) => step.own.map((own) => there.gradient(j, own))),
    ];
    const moves = slope.some((part) => part !== 0) && slope.every(Number.isFinite);
    const next = moves ? towards(slope) : direction;
    if (next.every((part, e) => Math.abs(part - direction[e]) < 1e-4)) break;
    direction = next;
  }
  return { best, where };
}

function stepsToZero(after, value) {
  let [low, high, atLow, atHigh] = [0, FAR, value, after(FAR)];
  if (atHigh > 0) return FAR;
  const secant = () => low + (high - low) * (atLow / Math.max(atLow - atHigh, 1e-300));
  for (let round = 0; round < 12; round++) {
    const middle = Number.isFinite(atHigh) ? secant() : (low + high) / 2;
    const there = after(middle);
    if (there > 0) [low, atLow] = [middle, there];
    else [high, atHigh] = [middle, there];
  }
  return secant() || low;
}

// A number with slopes of its own, as a coordinate or a way along several points. Where it has a kink, as a way has where
// two points meet, `kink` is what the variance to first order lacks.
function measureNumber(scene, points, valueOf) {
  if (points.some(({ point }) => point === null)) return UNKNOWN;
  const places = points.map(({ point }) => point);
  const { value, gradient } = valueOf(places);
  const slopes = columnsOf(
    points,
    points.map((_, j) => (step) => [gradient(j, step)]),
    1,
  ).map(([x]) => x);
  const first = sum(slopes.map((x) => x * x));
  const kink = kinkVariance(points, places, (at) => valueOf(at).value, first);
  const deviation = Math.sqrt(first + kink);
  if (isLost(points, gradient))
    return described({ value, deviation: Infinity, low: -Infinity, high: Infinity, reach: 0 });
  const reach = studentReach(freedomOf(scene, slopes, points.length));
  const [low, high] = [-1, 1].map((side) => extreme(scene, points, valueOf, value, slopes, side, reach).best);
  const lacking = deviation - Math.sqrt(first);
  return described({ value, deviation, low: low - reach * lacking, high: high + reach * lacking, reach });
}

function kinkVariance(points, places, valueOf, first) {
  const here = valueOf(places);
  const steps = points[0].shared.map((_, e) => points.map((point) => point.shared[e]));
  for (const [j, point] of points.entries()) {
    for (const own of point.own) steps.push(points.map((_, i) => (i === j ? own : [0, 0, 0])));
  }
  const change = (side) =>
    sum(steps.map((step) => (valueOf(places.map((place, j) => plus(place, step[j], side))) - here) ** 2));
  const excess = Math.max((change(-1) + change(1)) / 2 - first, 0);
  return first + excess > 0 ? excess ** 2 / (first + excess) : 0;
}

function described({ value, deviation, low, high, reach }) {
  const half = reach * deviation;
  const off = Math.max(Math.abs(low - value + half), Math.abs(high - value - half));
  return { value, deviation, low, high, nonlinear: off > 0.1 * half + 1e-9 * Math.abs(value) };
}

// ------------------------------------------------------------------------------------------------------ what is offered

const way = (closed) => (places) => {
  const count = places.length;
  const legs = Array.from({ length: closed ? count : count - 1 }, (_, n) => [n, (n + 1) % count]);
  const units = legs.map(([a, b]) => minus(places[b], places[a])).map((leg) => times(leg, 1 / (norm(leg) || 1)));
  const gradient = (j, step) =>
    sum(legs.map(([a, b], n) => (j === b ? dot(units[n], step) : 0) - (j === a ? dot(units[n], step) : 0)));
  return { value: sum(legs.map(([a, b]) => norm(minus(places[b], places[a])))), gradient };
};

const measureLength = (scene, pair) => measureNorm(scene, pair, difference);
const measureArea = (scene, outline) => measureNorm(scene, outline, areaVector);
const measurePerimeter = (scene, outline) => measureNumber(scene, outline, way(true));

function measureAngle(scene, triple) {
  const found = measureNorm(scene, triple, turn, Math.PI);
  const arms = [0, 2].map((end) => measureLength(scene, [triple[1], triple[end]]));
  const without = arms.some((arm) => arm.value === 0);
  const unclear = arms.some((arm) => arm.low === 0);
  return { ...found, deviation: without ? Infinity : found.deviation, ...(unclear ? { low: 0, high: Math.PI } : {}) };
}

function measureCoordinate(scene, point, axis) {
  return measureNumber(scene, [point], ([place]) => ({ value: place[axis], gradient: (_, step) => step[axis] }));
}

// Whether a point's deviations mislead, as close to the horizon: see `nonlinear` of the library.
function isBent(scene, point) {
  const found = [0, 1, 2].map((axis) => measureCoordinate(scene, point, axis));
  const most = Math.max(...found.map(({ deviation }) => deviation));
  return found.some(({ nonlinear, deviation }) => nonlinear && deviation > 1e-9 * most);
}

function deviationsOf({ shared, own, lost, nowhere }) {
  const steps = [...shared, ...own];
  // A coordinate that the plane fixes is known, wherever the point may be on it.
  const isLost = (axis) => (nowhere && own.some((step) => step[axis] !== 0)) || lost.some((step) => step[axis] !== 0);
  return [0, 1, 2].map((axis) => (isLost(axis) ? Infinity : Math.sqrt(sum(steps.map((step) => step[axis] ** 2)))));
}

// Everything that measuring needs, on one plane.
function makeScene(description, plane, sigma, pixelsToo) {
  const map = makeMap(makeCamera(description.camera), plane);
  return { map, sigma, pixelsToo, knowledge: makeKnowledge(description, map) };
}
