// The page: what the visitor does, and when which picture is drawn. While something moves pictures are as small as they have to be; at
// rest they are drawn whole, strip by strip.

const $ = id => document.getElementById(id);
const MOVING = 45, STRIP = 30, REST = 140;  // milliseconds: a picture in motion, strips between two looks at the visitor, until it rests
const LONGEST_SIDE = 1600, LEAST_SIDE = 96, LEAST_LINES = 8;
const SIZES = [1, 0.75, 0.5, 0.35, 0.25, 0.18, 0.125];  // of pictures in motion
const PASSES = [0.125, 0.25, 0.5, 1];  // of the whole picture's size, one after the other at rest
const ROUND = 14;  // seconds of a flight
const SHOW = ['colours', 'depth', 'opacity'];

function tell(text) {
  $('told').textContent = text;
  $('told').hidden = !text;
}

// For a moment only.
function brief(text) {
  tell(text);
  setTimeout(() => { if ($('told').textContent === text) tell(''); }, BRIEF);
}

class Page {
  constructor(about, field, gl) {
    Object.assign(this, {about, field, gl, canvas: gl.canvas});
    this.photo = about.start;
    this.walker = new Walker(poseOf(about.photos[this.photo].pose), about.depth);
    this.show = 0;
    this.perPixel = 4e-3;  // milliseconds, learnt as it goes
    this.keys = new Set();
    this.fingers = new Map();
    this.flight = null;  // {at: share of the way → pose, seconds, button, word}
    this.crop = null;
    this.moved = this.now = performance.now();
    this.part = this.todo = 0;  // of the whole size that is drawn, and lines that it lacks
    this.furnish();
    this.tools = new Tools(this);
    startVr(this);
    this.fit();
    requestAnimationFrame(now => this.tick(now));
  }

  // As many pixels as the window has, up to a bound.
  fit() {
    const box = this.canvas.getBoundingClientRect(), dense = window.devicePixelRatio || 1;
    const scale = Math.min(dense, LONGEST_SIDE / Math.max(box.width, box.height, 1));
    this.canvas.width = Math.max(16, Math.round(box.width * scale));
    this.canvas.height = Math.max(16, Math.round(box.height * scale));
    this.move();
    this.over();
  }

  move() {
    this.moved = performance.now();
    this.rough = true;
  }

  get photoLens() { return this.about.photos[this.photo].lens; }

  // The camera of a picture of this size: the photo's, so that all of the photo is in the window unless that has quite another shape.
  view(width, height) {
    const [w, h, fx, fy] = this.photoLens, whole = Math.min(width / w, height / h), full = Math.max(width / w, height / h);
    const scale = Math.max(whole, 0.6 * full), {turn, place} = this.walker.pose;
    const lens = [fx * scale, fy * scale, width / 2, height / 2];
    return {turn: turn.flat(), place, lens, show: this.show, range: this.about.range, crop: this.crop};
  }

  tick(now) {
    const passed = Math.min(100, now - this.now);
    this.now = now;
    if (this.step(now, passed)) {
      this.move();
      this.over();
    }
    try {
      if (this.away) this.todo = 0;  // a headset shows it
      else if (this.rough && (this.drawn !== this.moved || performance.now() - this.moved < REST)) this.small();
      else if (this.rough || this.todo) this.rest();
    } catch (error) {
      tell(error.message);
      return;
    }
    requestAnimationFrame(next => this.tick(next));
  }

  // What goes on by itself: keys held down, journeys, flights. Whether anything moved.
  step(now, passed) {
    const held = (more, less) => (this.keys.has(more) ? 1 : 0) - (this.keys.has(less) ? 1 : 0), fast = this.keys.has('shift') ? 3 : 1;
    const part = 0.6 * fast * passed / 1000 * this.walker.usual / this.walker.reach, angle = 1.2 * passed / 1000;
    const way = [held('d', 'a') * part, held('q', 'e') * part, held('w', 's') * part];
    const turn = [held('arrowleft', 'arrowright') * angle, held('arrowdown', 'arrowup') * angle];
    let moved = this.walker.travel(now);
    if (way.some(v => v)) this.walker.shift(...way), moved = true;
    if (turn.some(v => v)) this.walker.turn(...turn, false), moved = true;
    if (this.flight !== null) {
      this.flown = (this.flown + passed / 1000 / this.flight.seconds) % 1;
      this.walker.pose = this.flight.at(this.flown);
      moved = true;
    }
    return moved;
  }

  small() {
    if (this.drawn === this.moved) return;
    this.drawn = this.moved;
    const {width, height} = this.canvas, pixels = MOVING / this.perPixel;
    const size = SIZES.find(part => part * part * width * height <= pixels) || SIZES[SIZES.length - 1];
    const part = Math.max(size, Math.min(1, LEAST_SIDE / Math.max(width, height)));
    const target = this.field.target(Math.max(1, Math.round(width * part)), Math.max(1, Math.round(height * part)));
    this.draw(target, 0, target.height);
    this.field.put(target, null);
    this.last = target;
    this.part = part;
    this.todo = 0;
    this.rough = part < 1;
  }

  // Go on with the picture at rest, from coarse to whole and each from above, for as long as nobody notices.
  rest() {
    const begin = performance.now();
    if (this.rough) this.pass();
    this.rough = false;
    while (this.todo && performance.now() - begin < STRIP) {
      const lines = Math.min(this.todo, Math.max(LEAST_LINES, Math.floor(STRIP / (this.perPixel * this.last.width))));
      this.draw(this.last, this.todo - lines, this.todo);
      this.todo -= lines;
      if (!this.todo && this.part < 1) this.pass();
    }
    this.field.put(this.last, null);
  }

  // To the next larger picture, over what the one before shows.
  pass() {
    const {width, height} = this.canvas, before = this.last;
    this.part = PASSES.find(size => size > this.part) || 1;
    this.last = this.field.target(Math.max(1, Math.round(width * this.part)), Math.max(1, Math.round(height * this.part)));
    if (before && before !== this.last) this.field.put(before, this.last);
    this.todo = this.last.height;
  }

  draw(target, from, to, view = this.view(target.width, target.height)) {
    const begin = performance.now();
    //% if parts
    this.seen = view;
    //% endif
    this.field.strip(target, view, from, to);
    this.field.told(target, 0, from);  // waits
    const took = (performance.now() - begin) / (target.width * (to - from));
    this.perPixel = Math.min(2 * this.perPixel, Math.max(0.5 * this.perPixel, 0.7 * this.perPixel + 0.3 * took));
    if (!this.away) $('size').textContent = `${target.width}×${target.height}`;
  }

  // (H, W, 4) bytes, from above, of a camera that somebody names: twelve numbers and fx, fy, cx, cy.
  picture(pose, lens, width, height, show = 0) {
    const {turn, place} = poseOf(pose), gl = this.gl, target = this.field.target(width, height), line = 4 * width;
    const below = new Uint8Array(line * height), out = new Uint8Array(line * height);
    this.field.strip(target, {turn: turn.flat(), place, lens, show, range: this.about.range, crop: this.crop}, 0, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.decoded);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, below);
    for (let y = 0; y < height; y++) out.set(below.subarray((height - 1 - y) * line, (height - y) * line), y * line);
    return out;
  }

  furnish() {
    const photos = this.about.photos, canvas = this.canvas;
    const jump = by => this.to((this.photo + by + photos.length) % photos.length);
    $('before').onclick = () => jump(-1);
    $('after').onclick = () => jump(1);
    $('which').max = photos.length - 1;
    $('which').oninput = () => this.to(Number($('which').value));
    $('fly').onclick = () => this.fly(this.flight === null ? this.around() : null);
    $('show').onchange = () => { this.show = SHOW.indexOf($('show').value); this.move(); };
    $('help').onclick = () => { $('keys').hidden = !$('keys').hidden; };
    $('keys').onclick = () => { $('keys').hidden = true; };
    if (this.about.inside) [$('drags').textContent, $('shifts').textContent] = [$('shifts').textContent, $('drags').textContent];
    this.label();
    new ResizeObserver(() => this.fit()).observe(canvas);
    canvas.addEventListener('contextmenu', event => event.preventDefault());
    canvas.addEventListener('webglcontextlost', () => tell('The graphics card gave up; load the page again.'));
    canvas.addEventListener('pointerdown', event => {
      canvas.setPointerCapture(event.pointerId);
      this.fingers.set(event.pointerId, [event.clientX, event.clientY]);
      this.pressed = this.fingers.size === 1 && event.button === 0 ? [event.clientX, event.clientY] : null;
      this.stop();
    });
    canvas.addEventListener('pointermove', event => this.drag(event));
    canvas.addEventListener('pointerup', event => {
      const {pressed} = this;
      this.pressed = null;
      if (pressed && this.tools.measuring && Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]) < CLICK) this.tools.pick(...pressed);
    });
    for (const name of ['pointerup', 'pointercancel']) canvas.addEventListener(name, event => this.fingers.delete(event.pointerId));
    let face = null;  // of the crop box, that a hand holds
    $('over').addEventListener('pointerdown', event => {
      if (!event.target.dataset.face) return;
      face = {which: event.target.dataset.face.split(' ').map(Number), at: [event.clientX, event.clientY]};
      $('over').setPointerCapture(event.pointerId);
    });
    $('over').addEventListener('pointermove', event => {
      if (!face) return;
      const now = [event.clientX, event.clientY], by = [now[0] - face.at[0], now[1] - face.at[1]];
      face.at = now;
      this.tools.drag(face.which, by, this.projector());
    });
    for (const name of ['pointerup', 'pointercancel']) $('over').addEventListener(name, () => { face = null; });
    canvas.addEventListener('wheel', event => {
      event.preventDefault();
      this.stop();
      this.walker.approach(Math.exp(Math.max(-1, Math.min(1, event.deltaY * (event.deltaMode ? 0.05 : 0.0015)))));
      this.move();
      this.over();
    }, {passive: false});
    canvas.addEventListener('dblclick', event => this.lookAt(event.clientX, event.clientY));
    window.addEventListener('keydown', event => {
      const key = event.key.toLowerCase(), on = event.target.tagName;
      if (key === 'escape') {
        $('keys').hidden = true;
        this.tools.open(null);
      }
      const typed = on === 'INPUT' && (key.startsWith('arrow') || !['range', 'checkbox'].includes(event.target.type));
      if (event.ctrlKey || event.metaKey || event.altKey || on === 'SELECT' || typed) return;
      const tool = {v: 'views', p: 'path', m: 'measure', c: 'crop'}[key];
      if (tool && !event.repeat) this.tools.open(tool);
      if (key === '?') $('help').click();
      if (['w', 'a', 's', 'd', 'q', 'e', 'shift', 'arrowleft', 'arrowright', 'arrowup', 'arrowdown'].includes(key)) {
        this.keys.add(key);
        if (key !== 'shift') this.stop();
        event.preventDefault();
      }
    });
    window.addEventListener('keyup', event => this.keys.delete(event.key.toLowerCase()));
    window.addEventListener('blur', () => this.keys.clear());
  }

  label() {
    const {name, test} = this.about.photos[this.photo];
    $('which').value = this.photo;
    $('name').textContent = name + (test ? ' (held out)' : '');
  }

  to(photo) {
    this.photo = photo;
    this.label();
    this.go(poseOf(this.about.photos[photo].pose), this.about.depth, 500);
  }

  go(pose, reach, milliseconds) {
    this.stop();
    this.walker.go(pose, reach, milliseconds, performance.now());
  }

  stop() {
    this.fly(null);
    this.walker.journey = null;
  }

  // As the run's video goes.
  around() {
    const path = this.about.path.map(poseOf);
    const at = share => {
      const place = share * path.length, first = Math.floor(place) % path.length;
      return between(path[first], path[(first + 1) % path.length], place - Math.floor(place));
    };
    return {at, seconds: ROUND, button: 'fly', word: 'Fly'};
  }

  // Along a flight, or (null) no more.
  fly(flight) {
    if (flight === this.flight) return;
    if (this.flight) $(this.flight.button).textContent = this.flight.word;
    if (!flight) this.walker.reach = this.about.depth;
    this.flight = flight;
    this.flown = 0;
    this.walker.journey = null;
    if (flight) $(flight.button).textContent = 'Stop';
  }

  drag(event) {
    const before = this.fingers.get(event.pointerId);
    if (!before) return;
    const box = this.canvas.getBoundingClientRect(), long = Math.max(box.width, box.height), now = [event.clientX, event.clientY];
    const [dx, dy] = [now[0] - before[0], now[1] - before[1]];
    const per = this.canvas.width / box.width / this.view(this.canvas.width, this.canvas.height).lens[0];  // of the reach, a pixel
    if (this.fingers.size === 2) {
      const other = [...this.fingers].find(([id]) => id !== event.pointerId)[1];
      const apart = from => Math.hypot(from[0] - other[0], from[1] - other[1]);
      this.walker.approach(Math.max(0.5, Math.min(2, apart(before) / Math.max(apart(now), 1))));
      this.walker.shift(-dx * per / 2, -dy * per / 2, 0);
    } else if (event.buttons & 6 || event.ctrlKey) this.walker.shift(-dx * per, -dy * per, 0);
    else if (event.shiftKey !== this.about.inside) this.walker.turn(dx * per, -dy * per, false);  // what is seen follows the hand
    else this.walker.turn(-dx / long * 4, dy / long * 4, true);
    this.fingers.set(event.pointerId, now);
    this.move();
    this.over();
  }

  // The point of the field (working frame) at a place of the window, null where nothing solid is: by a picture of one pixel.
  pick(x, y) {
    const box = this.canvas.getBoundingClientRect(), target = this.field.target(1, 1), {width, height} = this.canvas;
    const column = (x - box.left) / box.width * width, row = (y - box.top) / box.height * height, view = this.view(width, height);
    const [fx, fy, cx, cy] = view.lens;
    this.field.strip(target, {...view, lens: [fx, fy, cx - column + 0.5, cy - row + 0.5]}, 0, 1);
    const [depth, opacity] = this.field.told(target, 0, 0), {turn, place} = this.walker.pose;
    if (!(depth > 0) || opacity < 0.5) return null;
    return turn.reduce((sum, axis, i) => plus(sum, axis, [(column - cx) / fx * depth, (row - cy) / fy * depth, depth][i]), place);
  }

  lookAt(x, y) {
    const point = this.tools.measuring ? null : this.pick(x, y);
    if (point) this.walker.lookAt(point, performance.now());
  }

  // Where the ends of a line from point to point are in the window, as much of it as is before the camera; [null] if none is.
  projector() {
    const box = this.canvas.getBoundingClientRect(), {lens: [fx, fy, cx, cy]} = this.view(box.width, box.height), {turn, place} = this.walker.pose;
    const near = 1e-3 * this.about.depth, seen = point => turn.map(axis => dot(axis, plus(point, place, -1)));
    return (one, two) => {
      const a = seen(one), b = seen(two);
      if (Math.max(a[2], b[2]) < near) return [null];
      const cut = (p, q) => p[2] >= near ? p : plus(p, plus(q, p, -1), (near - p[2]) / (q[2] - p[2]));
      return [cut(a, b), cut(b, a)].map(p => [fx * p[0] / p[2] + cx, fy * p[1] / p[2] + cy]);
    };
  }

  // What tools draw over the picture.
  over() {
    if (this.tools) $('over').innerHTML = this.tools.drawn(this.projector());
  }
}

async function begin() {
  const about = JSON.parse($('about').textContent);
  const gl = $('canvas').getContext('webgl2', {alpha: false, antialias: false, powerPreference: 'high-performance'});
  if (!gl) throw new Error('This page draws with WebGL 2, which this browser or device does not have; try another one.');
  if (!('DecompressionStream' in window)) throw new Error('This browser is too old for this page (it has no DecompressionStream).');
  const data = unpacked(await inflated($('field').textContent), about);
  $('field').textContent = '';
  const shaders = {march: $('march').textContent, decode: $('decode').textContent};
  window.fieldfuse = new Page(about, new Field(gl, about, shaders, data), gl);
  tell('');
  //% if parts
  window.fieldfuse.details = new Details(window.fieldfuse, data);
  //% endif
}

begin().catch(error => tell(error.message));
