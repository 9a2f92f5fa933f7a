// The variance of weighted sums of blocks: equations.md, 6.2, with the layout of the shared parameters of 6.1.
const stationCovariance = (() => {
  const POSE = 10, LINES = 5, TILTS_PER_REFRACTION = 5, MARGIN = 6;  // knots beyond which a fit no longer reaches
  const SIGHT = POSE, REFRACTION = POSE + 1, CROSS = POSE + 2, KNOT = POSE + 3;  // in a block's row

  function parse({ head, bytes }) {
    if (!head.parameters) return null;
    const floats = new Float32Array(bytes.buffer, 0, bytes.length / 4), p = head.parameters;
    const covariance = new Float64Array(p * p);
    let index = 0;
    for (let i = 0; i < p; i++) {
      for (let j = 0; j <= i; j++) covariance[i * p + j] = covariance[j * p + i] = floats[index++];
    }
    return { ...head, covariance, lineTilt: Float64Array.from(floats.subarray(index)) };
  }

  // The systematic variance [m²] of the sum of blocks with these weights; `rows` are their Jacobians.
  function variance(model, rows, weights) {
    const p = model.parameters, gradient = new Float64Array(p), used = new Set();
    const add = (k, value) => { gradient[k] += value; used.add(k); };
    const series = [  // derivative, first parameter, knots, sight-tilt knots between two of them
      [SIGHT, POSE, model.tilt_knots, 1],
      [REFRACTION, POSE + model.tilt_knots, model.refraction_knots, TILTS_PER_REFRACTION],
      [CROSS, POSE + model.tilt_knots + model.refraction_knots, model.refraction_knots, TILTS_PER_REFRACTION],
    ];
    const lines = new Map();
    rows.forEach((row, i) => {
      const w = weights[i];
      if (!w) return;
      for (let k = 0; k < POSE; k++) add(k, w * row[k]);
      for (const [derivative, first, knots, step] of series) {
        const position = row[KNOT] / step, lower = Math.floor(position), share = position - lower;
        add(first + lower, w * row[derivative] * (1 - share));
        add(first + (lower + 1) % knots, w * row[derivative] * share);
      }
      const line = Math.floor(row[KNOT] * LINES);
      lines.set(line, (lines.get(line) || 0) + w * row[SIGHT]);
    });
    let sum = 0;
    for (const i of used) for (const j of used) sum += gradient[i] * model.covariance[i * p + j] * gradient[j];
    return Math.max(sum, 0) + lineVariance(model, lines);
  }

  // Of the tilt of single lines, only what knots do not represent counts: the residual of a least-squares fit.
  function lineVariance(model, lines) {
    if (!lines.size) return 0;
    const n = model.intervals, wraps = model.tilt_knots === n, intervals = [...lines.keys()].map((l) => Math.floor(l / LINES));
    let low = Math.min(...intervals), high = Math.max(...intervals), turn = 0;
    if (wraps && high - low > n / 2) {  // across the first knot
      turn = n;
      const shifted = intervals.map((k) => k < n / 2 ? k + n : k);
      low = Math.min(...shifted);
      high = Math.max(...shifted);
    }
    low -= MARGIN;
    high += MARGIN;
    if (!wraps) { low = Math.max(low, 0); high = Math.min(high, n - 1); }
    const count = high - low + 1, effect = new Float64Array(count * LINES);
    for (const [line, value] of lines) {
      const shifted = turn && line < n * LINES / 2 ? line + turn * LINES : line;
      effect[shifted - low * LINES] += value;
    }
    const diagonal = new Float64Array(count + 1), off = new Float64Array(count), right = new Float64Array(count + 1);
    const share = (j) => (j % LINES + 0.5) / LINES;
    effect.forEach((value, j) => {
      const k = Math.floor(j / LINES), f = share(j);
      diagonal[k] += (1 - f) ** 2;
      diagonal[k + 1] += f ** 2;
      off[k] += f * (1 - f);
      right[k] += value * (1 - f);
      right[k + 1] += value * f;
    });
    for (let k = 0; k < count; k++) {  // the normal matrix is tridiagonal
      const factor = off[k] / diagonal[k];
      diagonal[k + 1] -= factor * off[k];
      right[k + 1] -= factor * right[k];
    }
    const knots = new Float64Array(count + 1);
    for (let k = count; k >= 0; k--) knots[k] = (right[k] - (k < count ? off[k] * knots[k + 1] : 0)) / diagonal[k];
    let sum = 0;
    effect.forEach((value, j) => {
      const k = Math.floor(j / LINES), f = share(j);
      const residual = value - (1 - f) * knots[k] - f * knots[k + 1];
      sum += residual ** 2 * model.lineTilt[POSE + ((k + low) % n + n) % n];
    });
    return sum;
  }

  return { parse, variance };
})();
