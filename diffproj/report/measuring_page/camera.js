// The camera at its pose, and the map between its pixels and the points of a plane n . X = d.
//
// Promises: `pointAt` gives the point of the plane that a pixel sees, or the reason why it sees none; `project` is the
// way back. Where there is a point, `slopesAt` has the derivative of the point by the pixel (3 x 2), and that of the
// pixel by the camera's parameters and its pose (2 x q). The world X_cam = R X + t; integer pixels are pixel centres.

const REASONS = {
  valid: "",
  lens: "outside the lens: no ray of light reaches this pixel",
  flat: "the camera itself lies in the plane",
  parallel: "on the horizon: its ray runs along the plane",
  behind: "beyond the horizon: its ray meets the plane only behind the camera",
};
const EPSILON = 2 ** -52;
const ROUNDING = 8 * EPSILON;

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const minus = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const plus = (a, b, factor = 1) => [a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]];
const times = (a, factor) => [a[0] * factor, a[1] * factor, a[2] * factor];
const norm = (a) => hypot(a[0], a[1], a[2]);
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const apply = (M, a) => [dot(M[0], a), dot(M[1], a), dot(M[2], a)];
const transposed = (M) => M[0].map((_, column) => M.map((row) => row[column]));
const sum = (numbers) => numbers.reduce((total, number) => total + number, 0);

function makeCamera({ K, R, t, lens }) {
  const [[a, b], [c, d]] = [K[0], K[1]];
  const determinant = a * d - b * c;
  const camera = {
    F: [
      [a, b],
      [c, d],
    ],
    center: [K[0][2], K[1][2]],
    R,
    t,
    lens: makeLens(lens),
  };
  camera.inverseF = [
    [d / determinant, -b / determinant],
    [-c / determinant, a / determinant],
  ];
  camera.back = transposed(R);
  camera.place = times(apply(camera.back, t), -1);
  return camera;
}

function normalized(camera, [u, v]) {
  const [du, dv] = [u - camera.center[0], v - camera.center[1]];
  return camera.inverseF.map((row) => row[0] * du + row[1] * dv);
}

function project(camera, point) {
  const found = camera.lens.project(plus(apply(camera.R, point), camera.t));
  return found && camera.F.map((row, axis) => row[0] * found[0] + row[1] * found[1] + camera.center[axis]);
}

function makePlane(normal, offset) {
  const length = norm(normal);
  const unit = times(normal, 1 / length);
  // Axes of the plane: x where that lies in it.
  const first = Math.abs(unit[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0];
  const along = plus(first, unit, -dot(first, unit));
  const x = times(along, 1 / norm(along));
  return { normal, offset, unit, distance: offset / length, axes: [x, cross(unit, x)] };
}

// The plane at a height over another, towards the camera.
function parallelPlane(plane, camera, height) {
  const side = dot(plane.unit, camera.place) >= plane.distance ? 1 : -1;
  return height === 0 ? plane : makePlane(plane.normal, plane.offset + side * height * norm(plane.normal));
}

// One 4 x 3 matrix [A; b] holds camera and plane: X = A p / (b . p), p the direction, or the pixel of a pinhole.
function makeMap(camera, plane) {
  const b = apply(camera.R, plane.normal);
  const height = plane.offset + dot(b, camera.t);
  let rows = camera.place.map((center, i) => camera.back[i].map((part, j) => center * b[j] + height * part));
  rows.push(b);
  const bare = camera.lens === pinhole;
  if (bare) {
    const [[f, g], [h, k]] = camera.inverseF;
    rows = rows.map(([x, y, z]) => [x * f + y * h, x * g + y * k, z]);
  }
  const reach = Math.abs(plane.offset) + norm(b) * norm(camera.t);
  const largest = Math.max(...rows.flat().map(Math.abs));
  const factor = Math.abs(height) > ROUNDING * reach ? (Math.sign(height) * 0.25) / largest : 0;
  rows = rows.map((row) => times(row, factor));
  const sizes = rows[3].map(Math.abs);
  const most = Math.max(...sizes);
  return {
    camera,
    plane,
    rows,
    bare,
    thresholds: sizes.map((size) => (size + most * EPSILON) * ROUNDING),
    flat: !factor,
  };
}

function pointAt(map, pixel) {
  const { camera, rows } = map;
  const sight = map.bare
    ? [pixel[0] - camera.center[0], pixel[1] - camera.center[1], 1]
    : camera.lens.unproject(normalized(camera, pixel));
  if (sight === null || !Number.isFinite(sight[0] + sight[1])) return { point: null, reason: "lens" };
  if (map.flat) return { point: null, reason: "flat" };
  const denominator = dot(rows[3], sight);
  const threshold = dot(map.thresholds, sight.map(Math.abs));
  if (!(denominator > threshold)) return { point: null, reason: denominator < -threshold ? "behind" : "parallel" };
  return { point: [0, 1, 2].map((i) => dot(rows[i], sight) / denominator), reason: "valid" };
}

// The derivative of the point by its pixel, 3 x 2, and that of the pixel by the point in the camera frame, 2 x 3.
function stretchAt(map, point) {
  const { camera, plane } = map;
  const direction = plus(apply(camera.R, point), camera.t);
  const g = camera.lens.byDirection(direction);
  const byCamera = camera.F.map((row) => [0, 1, 2].map((i) => row[0] * g[0][i] + row[1] * g[1][i]));
  const byPoint = byCamera.map((row) => apply(camera.back, row));
  const [[a, b], [c, d]] = byPoint.map((row) => plane.axes.map((axis) => dot(row, axis)));
  const determinant = a * d - b * c;
  const inverse = determinant
    ? [
        [d, -b],
        [-c, a],
      ].map((row) => row.map((x) => x / determinant))
    : [
        [0, 0],
        [0, 0],
      ];
  const [x, y] = plane.axes;
  const byPixel = [0, 1, 2].map((i) => [0, 1].map((j) => x[i] * inverse[0][j] + y[i] * inverse[1][j]));
  return { direction, byCamera, byPixel };
}

function slopesAt(map, pixel, point, { skew, middle, knows }) {
  const { camera } = map;
  const { direction, byCamera, byPixel } = stretchAt(map, point);
  if (!knows) return { byPixel, byTheta: [[], []] };
  const xy = normalized(camera, pixel);
  const arm = apply(camera.R, minus(point, middle));
  const byLens = camera.lens.byCoefficients(direction);
  const byTheta = [0, 1].map((row) => {
    const F = camera.F[row];
    const lens = byLens[0].map((_, i) => F[0] * byLens[0][i] + F[1] * byLens[1][i]);
    const focal = row ? [0, xy[1], 0, 1] : [xy[0], 0, 1, 0];
    return [...focal, ...lens, ...(skew ? [row ? 0 : xy[1]] : []), ...cross(arm, byCamera[row]), ...byCamera[row]];
  });
  return { byPixel, byTheta };
}
