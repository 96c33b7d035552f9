// Cameras in the input's frame, as files and links have them, and smooth ways between some of them.

// x_working = scale · turn · x_input + shift
class Frame {
  constructor({scale, turn, shift}) {
    Object.assign(this, {scale, shift, rows: [0, 3, 6].map(i => turn.slice(i, i + 3)), columns: [0, 1, 2].map(i => [turn[i], turn[3 + i], turn[6 + i]])});
  }

  toInput(point) { return times(this.columns.map(axis => dot(axis, plus(point, this.shift, -1))), 1 / this.scale); }

  toWorking(point) { return plus(this.shift, this.rows.map(row => dot(row, point)), this.scale); }

  // Sixteen numbers, row by row, of a camera with OpenGL's axes (right, up, back).
  matrix({turn: [right, down, forward], place}) {
    const axes = [right, times(down, -1), times(forward, -1)].map(axis => this.columns.map(column => dot(column, axis)));
    const at = this.toInput(place);
    return [0, 1, 2].flatMap(i => [...axes.map(axis => axis[i]), at[i]]).concat([0, 0, 0, 1]);
  }

  // The reverse, of what comes from anywhere: null if it is no camera.
  pose(numbers) {
    const m = Array.isArray(numbers) ? numbers.flat().map(Number) : [];
    if (m.length !== 16 || !m.every(v => Number.isFinite(v) && Math.abs(v) < 1e9)) return null;
    const axes = [0, 1, 2].map(i => this.rows.map(row => dot(row, [m[i], m[4 + i], m[8 + i]])));
    const forward = unit(times(axes[2], -1)), right = unit(cross(times(axes[1], -1), forward));
    if (Math.hypot(...forward) < 0.5 || Math.hypot(...right) < 0.5) return null;
    return {turn: [right, cross(forward, right), forward], place: this.toWorking([m[3], m[7], m[11]])};
  }
}

// (x, y, z, w) of the axes' turn, by the largest of them, and back.
function quaternion(turn) {
  const r = (i, j) => turn[j][i], trace = r(0, 0) + r(1, 1) + r(2, 2), sizes = [r(0, 0), r(1, 1), r(2, 2), trace];
  const i = sizes.indexOf(Math.max(...sizes)), j = (i + 1) % 3, k = (i + 2) % 3, q = [0, 0, 0, 0];
  if (i === 3) return unit([r(2, 1) - r(1, 2), r(0, 2) - r(2, 0), r(1, 0) - r(0, 1), 1 + trace]);
  q[i] = 1 - trace + 2 * r(i, i);
  q[j] = r(j, i) + r(i, j);
  q[k] = r(k, i) + r(i, k);
  q[3] = r(k, j) - r(j, k);
  return unit(q);
}

const turnOf = ([x, y, z, w]) => [
  [1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)],
  [2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)],
  [2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)],
];

// A smooth way through poses, evenly paced by distance and angle: cubic Hermite curves, slopes by neighbours, as `render/paths.py` has it.
class Route {
  constructor(poses, closed) {
    const all = closed && poses.length > 1 ? [...poses, poses[0]] : poses;
    this.values = all.map(({turn, place}) => [...place, ...quaternion(turn)]);
    for (let i = 1; i < all.length; i++) {  // of a turn's two quaternions the one beside that before it
      const [a, b] = [this.values[i - 1].slice(3), this.values[i].slice(3)];
      if (a.reduce((sum, v, n) => sum + v * b[n], 0) < 0) this.values[i] = this.values[i].map((v, n) => n < 3 ? v : -v);
    }
    const pairs = this.values.slice(1).map((value, i) => [this.values[i], value]);
    const moved = pairs.map(([a, b]) => Math.hypot(...[0, 1, 2].map(n => b[n] - a[n])));
    const turned = pairs.map(([a, b]) => 2 * Math.acos(Math.min(1, Math.abs([3, 4, 5, 6].reduce((sum, n) => sum + a[n] * b[n], 0)))));
    const mean = of => of.reduce((sum, v) => sum + v, 0) / Math.max(1, of.length);
    this.width = moved.map((v, i) => Math.max(1e-3, v / Math.max(mean(moved), 1e-12) + turned[i] / Math.max(mean(turned), 0.2)));
    const rise = pairs.map(([a, b], i) => b.map((v, n) => (v - a[n]) / this.width[i])), last = rise.length - 1;
    // The same turn at the end of a closed way may have the other quaternion there: its slope is of the other sign, too.
    const side = closed && last > 0 ? Math.sign([3, 4, 5, 6].reduce((sum, n) => sum + this.values[0][n] * this.values[last + 1][n], 0)) : 1;
    const flip = (slope) => slope.map((v, n) => n < 3 ? v : side * v);
    const middle = (i, j, before) => rise[j].map((v, n) => (before[n] * this.width[j] + v * this.width[i]) / (this.width[i] + this.width[j]));
    this.slope = this.values.map((_, i) => {
      if (last < 0) return null;
      if (i > 0 && i <= last) return middle(i - 1, i, rise[i - 1]);
      if (closed && last > 0) return i === 0 ? middle(last, 0, flip(rise[last])) : flip(middle(last, 0, flip(rise[last])));
      const [edge, inner] = i === 0 ? [0, 1] : [last, last - 1];
      if (last === 0) return rise[0];
      const near = i === 0 ? middle(0, 1, rise[0]) : middle(inner, edge, rise[inner]);
      return rise[edge].map((v, n) => 2 * v - near[n]);
    });
  }

  // The pose at a share of the way.
  at(share) {
    const total = this.width.reduce((sum, v) => sum + v, 0), end = this.width.length - 1;
    let rest = Math.max(0, Math.min(1, share)) * total, i = 0;
    while (i < end && rest > this.width[i]) rest -= this.width[i++];
    let value = this.values[0];
    if (end >= 0) {
      const w = this.width[i], u = Math.min(1, rest / w), v = 1 - u, [a, b, p, q] = [this.values[i], this.values[i + 1], this.slope[i], this.slope[i + 1]];
      value = a.map((_, n) => (1 + 2 * u) * v * v * a[n] + u * u * (3 - 2 * u) * b[n] + w * u * v * (v * p[n] - u * q[n]));
    }
    return {turn: turnOf(unit(value.slice(3))), place: value.slice(0, 3)};
  }
}
