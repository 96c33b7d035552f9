// Where the visitor stands, and what moves it. A pose is {turn: [right, down, forward], place}, world from camera, as OpenCV has it.

const plus = (a, b, s = 1) => a.map((v, i) => v + s * b[i]);
const times = (a, s) => a.map(v => v * s);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = a => times(a, 1 / (Math.hypot(...a) || 1));
const UP = [0, 0, 1];
const STEEP = 0.995;  // cosine between forward and up that a drag does not pass

function rotated(v, axis, angle) {
  const c = Math.cos(angle), s = Math.sin(angle);
  return plus(plus(times(v, c), cross(axis, v), s), axis, dot(axis, v) * (1 - c));
}

// Twelve numbers, three rows of four.
const poseOf = m => ({turn: [0, 1, 2].map(i => [m[i], m[4 + i], m[8 + i]]), place: [m[3], m[7], m[11]]});

function between(a, b, t) {
  const forward = unit(plus(times(a.turn[2], 1 - t), b.turn[2], t));
  const down = plus(times(a.turn[1], 1 - t), b.turn[1], t), right = unit(cross(down, forward));
  return {turn: [right, cross(forward, right), forward], place: plus(times(a.place, 1 - t), b.place, t)};
}

class Walker {
  constructor(pose, reach) {
    this.pose = pose;
    this.reach = this.usual = reach;  // to what is looked at, and turned about
    this.journey = null;
  }

  get pivot() { return plus(this.pose.place, this.pose.turn[2], this.reach); }

  // Turn by angles to the right and down; about the pivot, or on the spot.
  turn(right, down, about) {
    const pivot = this.pivot, old = this.pose.turn, upright = old[1][2] > 0 ? -1 : 1;
    let turn = old.map(v => rotated(v, UP, upright * right));
    const tilted = turn.map(v => rotated(v, turn[0], -down));
    if (Math.abs(tilted[2][2]) < STEEP || Math.abs(tilted[2][2]) < Math.abs(turn[2][2])) turn = tilted;
    this.pose = {turn, place: about ? plus(pivot, turn[2], -this.reach) : this.pose.place};
  }

  // Along right, down, forward, in parts of the reach.
  shift(right, down, forward) {
    const by = [right, down, forward];
    this.pose = {...this.pose, place: this.pose.turn.reduce((sum, axis, i) => plus(sum, axis, by[i] * this.reach), this.pose.place)};
  }

  // Nearer to the pivot or farther away; what is passed is not turned about any more.
  approach(factor) {
    const least = 0.05 * this.usual, next = this.reach * factor;
    this.pose = {...this.pose, place: plus(this.pose.place, this.pose.turn[2], this.reach - next)};
    this.reach = Math.max(next, least);
  }

  go(pose, reach, milliseconds, now) {
    this.journey = {from: this.pose, to: pose, since: now, milliseconds, reach};
  }

  // To where the point `point` is in the middle.
  lookAt(point, now) {
    const way = plus(point, this.pose.place, -1), forward = unit(way), right = unit(cross(this.pose.turn[1], forward));
    this.go({turn: [right, cross(forward, right), forward], place: this.pose.place}, Math.hypot(...way), 350, now);
  }

  // Whether it moved.
  travel(now) {
    if (!this.journey) return false;
    const {from, to, since, milliseconds, reach} = this.journey, t = Math.max(0, Math.min(1, (now - since) / Math.max(1, milliseconds)));
    this.pose = t === 1 ? to : between(from, to, t * t * (3 - 2 * t));
    if (t === 1) {
      this.reach = reach;
      this.journey = null;
    }
    return true;
  }
}
