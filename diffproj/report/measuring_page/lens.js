// The lenses: from viewing directions (x right, y down, z forward) to distorted points of the plane z = 1, and back.
//
// Promises: inside a lens's domain `unproject` is the exact inverse of `project`; outside of it both give null.
// `byDirection` and `byCoefficients` are the derivatives of the distorted point, 2 x 3 and 2 x k, in closed form.

// Math.hypot takes ten times as long; no square overflows here.
const hypot = (a, b, c = 0, d = 0) => Math.sqrt(a * a + b * b + c * c + d * d);

function makeLens({ kind, coefficients, domain }) {
  if (kind === "none") return pinhole;
  const end = domain === null ? Infinity : domain;
  return kind === "fisheye" ? fisheyeLens(coefficients, end) : brownLens(coefficients, end);
}

const pinhole = {
  count: 0,
  project: ([x, y, z]) => (z > 1e-150 ? [x / z, y / z] : null),
  unproject: ([x, y]) => [x, y, 1],
  byDirection: ([x, y, z]) => [
    [1 / z, 0, -x / (z * z)],
    [0, 1 / z, -y / (z * z)],
  ],
  byCoefficients: () => [[], []],
};

// ------------------------------------------------------------------------------------------------- Brown and Conrady

function brownLens(c, domain) {
  const [k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, tauX, tauY] = Array.from({ length: 14 }, (_, i) => c[i] ?? 0);
  const [cx, sx, cy, sy] = [Math.cos(tauX), Math.sin(tauX), Math.cos(tauY), Math.sin(tauY)];
  const isTilted = c.length > 12;

  // The point (x', y') before the tilt, with its Jacobian.
  function bend(x, y) {
    const s = x * x + y * y;
    const below = 1 + s * (k4 + s * (k5 + s * k6));
    const growth = (k1 - k4 + s * (k2 - k5 + s * (k3 - k6))) / below;
    const g = 1 + s * growth;
    const slope = (2 * (k1 + s * (2 * k2 + s * 3 * k3)) - 2 * g * (k4 + s * (2 * k5 + s * 3 * k6))) / below; // 2 dg / ds
    const [steepX, steepY] = [2 * (s1 + 2 * s2 * s), 2 * (s3 + 2 * s4 * s)];
    return {
      x: x * g + 2 * p1 * x * y + p2 * (s + 2 * x * x) + s * (s1 + s2 * s),
      y: y * g + p1 * (s + 2 * y * y) + 2 * p2 * x * y + s * (s3 + s4 * s),
      xx: g + x * x * slope + 2 * p1 * y + 6 * p2 * x + x * steepX,
      xy: x * y * slope + 2 * p1 * x + 2 * p2 * y + y * steepX,
      yx: x * y * slope + 2 * p1 * x + 2 * p2 * y + x * steepY,
      yy: g + y * y * slope + 6 * p1 * y + 2 * p2 * x + y * steepY,
    };
  }

  const depthAt = (x, y) => sy * x - cy * sx * y + cx * cy;

  // The same behind the tilted sensor.
  function forward(x, y) {
    const bent = bend(x, y);
    if (!isTilted) return bent;
    const depth = depthAt(bent.x, bent.y);
    const [X, Y] = [(cx * bent.x) / depth, (cy * bent.y - sx * sy * bent.x) / depth];
    const [xx, xy] = [(cx - X * sy) / depth, (X * cy * sx) / depth];
    const [yx, yy] = [(-sx * sy - Y * sy) / depth, (cy + Y * cy * sx) / depth];
    return {
      x: X,
      y: Y,
      xx: xx * bent.xx + xy * bent.yx,
      xy: xx * bent.xy + xy * bent.yy,
      yx: yx * bent.xx + yy * bent.yx,
      yy: yx * bent.xy + yy * bent.yy,
    };
  }

  // The point before the tilt of one behind it; null beyond the tilted sensor's horizon.
  function untilted(X, Y) {
    if (!isTilted) return [X, Y];
    const x = X / cx;
    const y = (Y + sx * sy * x) / cy;
    const inverseDepth = (1 - sy * x + cy * sx * y) / (cx * cy);
    return inverseDepth > 0 ? [x / inverseDepth, y / inverseDepth] : null;
  }

  // Newton's steps: enough nearly everywhere. A solution inside the domain is the only one there.
  function quick(goalX, goalY, start) {
    let [x, y] = start;
    for (let step = 0; step < 12; step++) {
      const there = forward(x, y);
      const [offX, offY] = [goalX - there.x, goalY - there.y];
      const determinant = there.xx * there.yy - there.xy * there.yx;
      const dx = (there.yy * offX - there.xy * offY) / determinant;
      const dy = (there.xx * offY - there.yx * offX) / determinant;
      x += dx;
      y += dy;
      const size = hypot(x, y);
      if (!(size <= 2 * domain)) return null;
      if (hypot(dx, dy) <= 4e-16 * size || size === 0) return size <= domain ? [x, y] : null;
    }
    return null;
  }

  // Damped Newton on the lens extended beyond its disc by G(z) = F(p) + stiffness (z - p), p the disc's closest point
  // to z: one-to-one on the whole plane, so that there is one solution, whatever the start.
  function patient(goalX, goalY, start) {
    let [x, y] = onRay(goalX, goalY, start);
    const there = forward(x, y);
    const stiffness = hypot(there.xx, there.xy, there.yx, there.yy) / Math.SQRT2;
    let [share, off, at, step] = [1, Infinity, [x, y], [0, 0]];
    for (let round = 0; round < 200; round++) {
      const next = extended(goalX, goalY, x, y, stiffness);
      const accepted = next.off < (1 - 1e-4 * share) * off;
      if (accepted) [off, at, step] = [next.off, [x, y], next.step];
      const small = hypot(...step) <= 2.3e-16 * hypot(...at);
      if (Math.sqrt(off) <= 2.3e-16 * hypot(goalX, goalY) || small || share <= 1e-9) break;
      share = accepted ? Math.min(2 * share, 1) : share / 4;
      [x, y] = stepped(at, [share * step[0], share * step[1]]);
    }
    const [size, rest] = [hypot(...at), Math.sqrt(off)];
    return size <= domain && rest <= 1e-11 * (hypot(goalX, goalY) + stiffness * size) ? at : null;
  }

  function onRay(goalX, goalY, [x, y]) {
    const size = hypot(goalX, goalY);
    const [towardsX, towardsY] = size > 0 ? [goalX / size, goalY / size] : [0, 0];
    let [low, high] = [0, domain < Infinity ? domain : 0];
    for (let round = 0; round < 24; round++) {
      const middle = (low + high) / 2;
      const there = forward(towardsX * middle, towardsY * middle);
      if (towardsX * there.x + towardsY * there.y < size) low = middle;
      else high = middle;
    }
    const distance = hypot(x, y);
    const shrink = distance > domain ? domain / distance : 1;
    const starts = [
      [x * shrink, y * shrink],
      [towardsX * low, towardsY * low],
    ];
    const offs = starts.map(([a, b]) => hypot(goalX - forward(a, b).x, goalY - forward(a, b).y));
    return offs[0] < offs[1] ? starts[0] : starts[1];
  }

  function extended(goalX, goalY, x, y, stiffness) {
    const distance = hypot(x, y);
    const outside = distance > domain;
    const shrink = outside ? domain / distance : 1;
    const there = forward(x * shrink, y * shrink);
    const offX = goalX - there.x - stiffness * (x - x * shrink);
    const offY = goalY - there.y - stiffness * (y - y * shrink);
    let { xx, xy, yx, yy } = there;
    if (outside) {
      const [a, b] = [x / distance, y / distance];
      const [pxx, pxy, pyy] = [shrink * b * b, -shrink * a * b, shrink * a * a];
      [xx, xy, yx, yy] = [
        xx * pxx + xy * pxy + stiffness * (1 - pxx),
        xx * pxy + xy * pyy - stiffness * pxy,
        yx * pxx + yy * pxy - stiffness * pxy,
        yx * pxy + yy * pyy + stiffness * (1 - pyy),
      ];
    }
    const determinant = xx * yy - xy * yx;
    const step = [(yy * offX - xy * offY) / determinant, (xx * offY - yx * offX) / determinant];
    return { off: offX * offX + offY * offY, step };
  }

  // At most 0.9 of the way to the edge in one step, and around the centre along the circle.
  function stepped([x, y], [dx, dy]) {
    const distance = hypot(x, y);
    const length = Math.max(distance, 1e-300);
    const [along, sideways] = [(x * dx + y * dy) / length, (x * dy - y * dx) / length];
    let next = [x + dx, y + dy];
    if (Math.abs(sideways) < distance / 2 && along > -distance / 2) {
      const [angle, ahead] = [sideways / length, (distance + along) / length];
      const [cosine, sine] = [Math.cos(angle), Math.sin(angle)];
      next = [ahead * (x * cosine - y * sine), ahead * (x * sine + y * cosine)];
    }
    const most = domain - distance > 1e-7 * domain ? distance + 0.9 * (domain - distance) : Infinity;
    const size = hypot(...next);
    return size > most ? next.map((part) => (part * most) / size) : next;
  }

  function undistorted(X, Y) {
    const start = untilted(X, Y);
    if (start === null || !(domain > 0)) return null;
    return quick(X, Y, start) ?? patient(X, Y, start);
  }

  function byCoefficients([X, Y, Z]) {
    const [x, y] = [X / Z, Y / Z];
    const s = x * x + y * y;
    const below = 1 + s * (k4 + s * (k5 + s * k6));
    const g = 1 + (s * (k1 - k4 + s * (k2 - k5 + s * (k3 - k6)))) / below;
    const powers = [s, s * s, s * s * s].map((power) => [(x * power) / below, (y * power) / below]);
    let columns = [powers[0], powers[1], [2 * x * y, s + 2 * y * y], [s + 2 * x * x, 2 * x * y], powers[2]];
    columns.push(...powers.map(([u, v]) => [-g * u, -g * v]), [s, 0], [s * s, 0], [0, s], [0, s * s]);
    if (isTilted) columns = byTilt(bend(x, y), columns);
    return [0, 1].map((row) => columns.slice(0, c.length).map((column) => column[row]));
  }

  function byTilt({ x, y }, columns) {
    const depth = depthAt(x, y);
    const [X, Y] = [(cx * x) / depth, (cy * y - sx * sy * x) / depth];
    const [fallX, fallY] = [-cy * (cx * y + sx), cy * x + sy * (sx * y - cx)];
    const onward = ([u, v]) => {
      const fall = sy * u - cy * sx * v;
      return [(cx * u - X * fall) / depth, (cy * v - sx * sy * u - Y * fall) / depth];
    };
    return [
      ...columns.map(onward),
      [(-sx * x - X * fallX) / depth, (-cx * sy * x - Y * fallX) / depth],
      [(-X * fallY) / depth, (-sy * y - sx * cy * x - Y * fallY) / depth],
    ];
  }

  return {
    count: c.length,
    project([x, y, z]) {
      if (!(z > 1e-150) || !(hypot(x, y) <= domain * z)) return null;
      const there = forward(x / z, y / z);
      return Number.isFinite(there.x + there.y) ? [there.x, there.y] : null;
    },
    unproject([x, y]) {
      const found = undistorted(x, y);
      return found && [...found, 1];
    },
    byDirection([X, Y, z]) {
      const [x, y] = [X / z, Y / z];
      const { xx, xy, yx, yy } = forward(x, y);
      return [
        [xx, xy, -(xx * x + xy * y)],
        [yx, yy, -(yx * x + yy * y)],
      ].map((row) => row.map((part) => part / z));
    },
    byCoefficients,
  };
}

// ----------------------------------------------------------------------------------------------------------- fisheye

function fisheyeLens(k, domain) {
  const profile = (square) => 1 + square * (k[0] + square * (k[1] + square * (k[2] + square * k[3])));
  const slope = (square) => 1 + square * (3 * k[0] + square * (5 * k[1] + square * (7 * k[2] + square * 9 * k[3])));
  const rise = (angle) => angle * profile(angle * angle);
  const reach = rise(domain);

  // The angle over the side, smooth on the axis too, with its slopes by the square of the side and by z.
  function angleOverSide(square, z) {
    const byZ = -1 / (square + z * z);
    if (z > 0 && square < 0.02 * z * z) {
      const q = square / (z * z);
      let [sum, rising] = [0, 0];
      for (let n = 10; n >= 0; n--) sum = sum * q + (n % 2 ? -1 : 1) / (2 * n + 1);
      for (let n = 10; n >= 1; n--) rising = rising * q + ((n % 2 ? -1 : 1) * n) / (2 * n + 1);
      return [sum / z, rising / (z * z * z), byZ];
    }
    const ratio = Math.atan2(Math.sqrt(square), z) / Math.sqrt(square);
    return [ratio, (-z * byZ - ratio) / (2 * square), byZ];
  }

  function scaled(direction) {
    const size = Math.max(...direction.map(Math.abs)) || 1;
    return [...direction.map((part) => part / size), size];
  }

  return {
    count: 4,
    project(direction) {
      const [x, y, z] = scaled(direction);
      const side = hypot(x, y);
      const aside = side > 2.3e-16 || z > 2.3e-16;
      if (!(Math.atan2(side, z) <= domain) || !aside || !(domain > 0)) return null;
      const [ratio] = angleOverSide(side * side, z);
      const scale = ratio * profile(ratio * ratio * side * side);
      return [x * scale, y * scale];
    },
    unproject([x, y]) {
      const rho = hypot(x, y);
      if (!(rho <= reach) || !(domain > 0)) return null;
      let [low, high, angle] = [0, domain, Math.min(rho, domain)];
      for (let step = 0; step < 80; step++) {
        const over = rise(angle) - rho;
        if (over <= 0) low = angle;
        if (over >= 0) high = angle;
        const newton = angle - over / slope(angle * angle);
        const next = newton >= low && newton <= high ? newton : (low + high) / 2;
        const moved = Math.abs(next - angle);
        angle = next;
        if (moved <= 2.3e-16 * angle) break;
      }
      const scale = rho > 0 ? Math.sin(angle) / rho : 1;
      return [x * scale, y * scale, Math.cos(angle)];
    },
    byDirection(direction) {
      const [x, y, z, size] = scaled(direction);
      const square = x * x + y * y;
      const [ratio, bySquare, byZ] = angleOverSide(square, z);
      const angleSquare = ratio * ratio * square;
      const g = profile(angleSquare);
      const rising = ratio * (k[0] + angleSquare * (2 * k[1] + angleSquare * (3 * k[2] + angleSquare * 4 * k[3])));
      const scale = ratio * g;
      const steep = 2 * (bySquare * g + rising * (2 * ratio * bySquare * square + ratio * ratio));
      const fall = byZ * (g + 2 * rising * ratio * square);
      const rows = [
        [scale + steep * x * x, steep * x * y, fall * x],
        [steep * x * y, scale + steep * y * y, fall * y],
      ];
      return rows.map((row) => row.map((part) => part / size));
    },
    byCoefficients(direction) {
      const [x, y, z] = scaled(direction);
      const square = x * x + y * y;
      const [ratio] = angleOverSide(square, z);
      const powers = [1, 2, 3, 4].map((n) => ratio * (ratio * ratio * square) ** n);
      return [powers.map((power) => x * power), powers.map((power) => y * power)];
    },
  };
}
