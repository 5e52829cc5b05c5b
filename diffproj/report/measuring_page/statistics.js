// How far an interval reaches, and what an error bar means for a length near zero.
//
// Promises: `studentReach` gives Student's quantile for 95 % to rounding, for any degrees of freedom from 1 on;
// `lowerBound` and `upperBound` are the bounds of the length of a noisy vector, which knows no negative values.

const LEVEL = 0.95;
const NORMAL_REACH = 1.959963984540054;
const [NEAR, FAR] = [6, 12];

// Nodes and weights of Gauss and Legendre on -1 to 1.
function legendre(count) {
  return Array.from({ length: count }, (_, index) => {
    let x = -Math.cos((Math.PI * (index + 0.75)) / (count + 0.5));
    let slope = 1;
    for (let step = 0; step < 8; step++) {
      let [before, now] = [1, x];
      for (let n = 2; n <= count; n++) [before, now] = [now, ((2 * n - 1) * x * now - (n - 1) * before) / n];
      slope = (count * (x * now - before)) / (x * x - 1);
      x -= now / slope;
    }
    return [x, 2 / ((1 - x * x) * slope * slope)];
  });
}
const [FINE, COARSE] = [legendre(64), legendre(24)];

// Lanczos' series.
function logGamma(x) {
  const terms = [
    676.5203681218851, -1259.1392167224028, 771.3234287776531, -176.6150291621406, 12.507343278686905,
    -0.13857109526572012, 9.984369578019572e-6, 1.5056327351493116e-7,
  ];
  if (x < 0.5) return Math.log(Math.PI / Math.sin(Math.PI * x)) - logGamma(1 - x);
  const total = terms.reduce((total, term, n) => total + term / (x + n), 0.9999999999998099);
  const t = x + 6.5;
  return 0.5 * Math.log(2 * Math.PI) + (x - 0.5) * Math.log(t) - t + Math.log(total);
}

function studentReach(n) {
  if (Number.isNaN(n)) return NaN;
  if (!(n > 0)) return Infinity;
  const z = NORMAL_REACH;
  if (n >= 1000) {
    const [a, b] = [(z ** 3 + z) / 4, (5 * z ** 5 + 16 * z ** 3 + 3 * z) / 96];
    const c = (3 * z ** 7 + 19 * z ** 5 + 17 * z ** 3 - 15 * z) / 384;
    return z + (a + (b + c / n) / n) / n;
  }
  const scale = Math.exp(logGamma((n + 1) / 2) - logGamma(n / 2)) * (2 / Math.sqrt(Math.PI));
  let phi = 0;
  for (let round = 0; round < 100; round++) {
    const inside = sum(FINE.map(([x, w]) => (Math.cos((phi * (1 + x)) / 2) ** (n - 1) * w) / 2)) * phi;
    const step = (LEVEL / scale - inside) / Math.cos(phi) ** (n - 1);
    phi = Math.min(phi + step, (phi + Math.PI / 2) / 2);
    if (step <= 1e-15 * phi) break;
  }
  return Math.sqrt(n) * Math.tan(phi);
}

// The normal distribution, by its series and by its continued fraction.
function normalBelow(x) {
  if (x < -38) return 0;
  if (x > 38) return 1;
  const density = Math.exp((-x * x) / 2) / Math.sqrt(2 * Math.PI);
  if (Math.abs(x) < 4) {
    let [term, total] = [x, x];
    for (let n = 1; Math.abs(term) > 1e-18 * Math.abs(total); n++) total += term *= (x * x) / (2 * n + 1);
    return 0.5 + density * total;
  }
  let fraction = 0;
  for (let n = 60; n >= 1; n--) fraction = n / (Math.abs(x) + fraction);
  const tail = density / (Math.abs(x) + fraction);
  return x > 0 ? 1 - tail : tail;
}

// Eigenvalues and vectors of a symmetric 3 x 3 matrix by Jacobi's rotations: the largest and its vector.
function longestAxis(C) {
  const A = C.map((row) => [...row]);
  const V = [
    [1, 0, 0],
    [0, 1, 0],
    [0, 0, 1],
  ];
  for (let sweep = 0; sweep < 30; sweep++) {
    for (const [p, q] of [
      [0, 1],
      [0, 2],
      [1, 2],
    ]) {
      if (A[p][q] === 0) continue;
      const theta = (A[q][q] - A[p][p]) / (2 * A[p][q]);
      const t = (theta < 0 ? -1 : 1) / (Math.abs(theta) + hypot(theta, 1));
      const c = 1 / hypot(t, 1);
      const s = t * c;
      for (let k = 0; k < 3; k++) [A[k][p], A[k][q]] = [c * A[k][p] - s * A[k][q], s * A[k][p] + c * A[k][q]];
      for (let k = 0; k < 3; k++) [A[p][k], A[q][k]] = [c * A[p][k] - s * A[q][k], s * A[p][k] + c * A[q][k]];
      for (let k = 0; k < 3; k++) [V[k][p], V[k][q]] = [c * V[k][p] - s * V[k][q], s * V[k][p] + c * V[k][q]];
    }
  }
  const best = [0, 1, 2].reduce((one, other) => (A[other][other] > A[one][one] ? other : one));
  return { largest: Math.max(A[best][best], 0), axis: V.map((row) => row[best]) };
}

const nearness = (r, largest) =>
  Math.min(Math.max((FAR - r / Math.max(Math.sqrt(largest), 1e-300)) / (FAR - NEAR), 0), 1);

// The smallest length, in deviations along it, that a measured one of r is compatible with.
function lowerBound(r, across, correlated, largest) {
  const z = NORMAL_REACH;
  const plain = Math.max(r - z, 0);
  const weight = nearness(r, largest);
  if (weight === 0) return plain;
  const spread = Math.max(across, 1e-12);
  const below = (x, length) => probabilityBelow(x, length, spread, correlated);
  const surprise = (length) => below(r, length) - LEVEL - (length > z ? below(length - z, length) : 0);
  let [low, high] = [0, r];
  for (let round = 0; round < 40; round++) {
    const middle = (low + high) / 2;
    if (surprise(middle) > 0) low = middle;
    else high = middle;
  }
  const found = surprise(0) > 0 ? (low + high) / 2 : 0;
  return weight < 1 ? weight * found + (1 - weight) * plain : found;
}

// The probability that a vector of that true length is measured as shorter than x; its variance along itself is 1.
function probabilityBelow(x, length, across, correlated) {
  const tau = Math.sqrt(across);
  const end = Math.asin(Math.min((6 * tau) / Math.max(x, 1e-300), 1));
  const slope = Math.sqrt(correlated) / across;
  const left = Math.sqrt(Math.max(1 - correlated / across, 1e-12));
  let total = 0;
  for (const [node, weight] of COARSE) {
    const [e, half] = [x * Math.sin(end * node), x * Math.cos(end * node)];
    const middle = length + slope * e;
    const inside = normalBelow((half - middle) / left) - normalBelow((-half - middle) / left);
    total += (Math.exp(-((e / tau) ** 2) / 2) / (tau * Math.sqrt(2 * Math.PI))) * half * inside * weight;
  }
  return total * end;
}

// The length of the longest vector within the normal reach of w, with covariance C.
function upperBound(w, C, { largest, axis }) {
  const [r, z] = [norm(w), NORMAL_REACH];
  const sigma = (u) => Math.sqrt(Math.max(dot(u, apply(C, u)), 0));
  const plain = r + z * sigma(times(w, 1 / Math.max(r, 1e-300)));
  const weight = nearness(r, largest);
  if (weight === 0) return plain;
  let at = plus(w, axis, (dot(axis, w) < 0 ? -1 : 1) * z * Math.sqrt(largest));
  for (let round = 0; round < 40; round++) {
    const u = times(at, 1 / Math.max(norm(at), 1e-300));
    const s = sigma(u);
    at = plus(w, apply(C, u), s > 0 ? z / s : 0);
  }
  return weight * norm(at) + (1 - weight) * plain;
}
