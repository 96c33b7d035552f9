// Details of a field that is too large for its page: parts of `field_parts/` beside it (`export/parts.py`), where the page is served.
// Those nearest to the visitor are fetched, unpacked beside the page's own work, and drawn instead of the coarse blocks that they lie in,
// until the memory for them is full; then the farthest go.

const LOOK = 250;  // milliseconds between two looks at what is near
const AT_ONCE = 2;  // parts that are on their way
const AHEAD = 0.5;  // cosine to the direction of view of what is ahead …
const BEHIND = 3;  // … and what is not counts as if it were so many times as far
const STICKY = 1.2;  // a part goes for another that is nearer by this
const AGAIN = 30000;  // milliseconds until what failed is asked for once more
const SERVED = 'A coarse view of the whole scene: details load when this folder is served, as by `fieldfuse view DIR`.';
const LISTS = {  // textures that grow: format, what of a part counts, entries and words of each
  slices: ['RGBA32UI', 'RGBA_INTEGER', 'blocks', 8, 4],
  rows: ['RG32UI', 'RG_INTEGER', 'blocks', 81, 2],
  densities: ['RG32UI', 'RG_INTEGER', 'voxels', 1, 2],
  features: ['RGBA32UI', 'RGBA_INTEGER', 'corners', 1, 4],
};

class Details {
  constructor(page, coarse) {
    const {about, field} = page, {gl} = field;
    Object.assign(this, {page, field, gl, about, coarse, ratio: about.parts.ratio, parts: [], failed: false});
    this.children = new Int32Array(coarse.keys.length / 3 * this.ratio ** 3).fill(-1);
    field.textures.children = this.list('R32I', this.children.length);
    this.shown();
    if (location.protocol === 'file:') this.say(SERVED);
    else this.start();
  }

  start() { this.open().catch(error => { this.say(SERVED); brief(error.message); }); }

  say(text) { $('details').textContent = text; }

  async open() {
    const answer = await fetch('field_parts/index.json', {cache: 'no-cache'}).catch(() => null), {about, coarse} = this;
    if (!answer) {
      setTimeout(() => this.start(), AGAIN);
      throw new Error('The details cannot be reached just now: the page asks again in half a minute.');
    }
    if (!answer.ok) throw new Error('The folder field_parts is not beside this page: what is shown stays coarse.');
    const index = await answer.json().catch(() => ({}));
    if (index.version !== 1 || index.field !== about.parts.field) throw new Error('The folder field_parts belongs to another page: what is shown stays coarse.');
    this.own = {blocks: coarse.keys.length / 3, voxels: coarse.voxels, corners: coarse.feature.length / 16};
    this.most = {};
    for (const what of Object.keys(this.own)) this.most[what] = Math.max(...index.parts.map(part => part[what]));
    const bytes = 776 * this.most.blocks + 8 * this.most.voxels + 16 * this.most.corners, lines = this.gl.getParameter(this.gl.MAX_TEXTURE_SIZE);
    let slots = Math.min(index.parts.length, Math.floor(about.parts.budget / bytes));
    for (const [, , what, each] of Object.values(LISTS))
      slots = Math.min(slots, Math.floor(((lines << WIDTH_BITS) / each - this.own[what]) / this.most[what]));
    while (slots > 0 && !this.grow(slots)) slots >>= 1;
    if (slots < 1) throw new Error('This device has no room for details: what is shown stays coarse.');
    this.slots = slots;
    this.free = Array.from({length: slots}, (_, i) => i);
    this.parts = index.parts.map(part => ({...part, slot: null, here: false, again: 0}));
    this.worker = partWorker();
    this.coarse = {keys: coarse.keys, table: coarse.table};  // the rest is on the graphics card
    this.middle = this.middles();
    setInterval(() => this.look(), LOOK);
    this.look();
  }

  // A texture of so many entries, 4096 a line.
  list(inside, count) {
    const gl = this.gl, made = this.field.texture(gl.TEXTURE_2D, gl.NEAREST), width = 1 << WIDTH_BITS;
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl[inside], width, Math.max(1, Math.ceil(count / width)));
    return made;
  }

  // Values of `each` words into a texture's entries from `first`.
  put(texture, format, type, first, values, each) {
    const gl = this.gl, width = 1 << WIDTH_BITS, count = values.length / each;
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    for (let done = 0; done < count;) {
      const x = (first + done) % width, y = Math.floor((first + done) / width), whole = x ? 0 : Math.floor((count - done) / width);
      const size = whole ? whole * width : Math.min(width - x, count - done);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, x, y, whole ? width : size, whole || 1, gl[format], gl[type], values.subarray(done * each, (done + size) * each));
      done += size;
    }
  }

  // Textures with room for parts behind the coarse blocks; whether the device has it.
  grow(slots) {
    const {gl, field, coarse, own, most} = this, made = {};
    const values = {slices: coarse.slices, rows: coarse.rows, densities: new Uint32Array(coarse.densities.buffer), features: wordsOf(coarse.feature)};
    while (gl.getError() !== gl.NO_ERROR);
    for (const [name, [inside, format, what, each, words]] of Object.entries(LISTS)) {
      made[name] = this.list(inside, each * (own[what] + slots * most[what]));
      this.put(made[name], format, 'UNSIGNED_INT', 0, values[name], words);
    }
    const fits = gl.getError() === gl.NO_ERROR;
    for (const [name, texture] of Object.entries(made)) {
      gl.deleteTexture(fits ? field.textures[name] : texture);
      if (fits) field.textures[name] = texture;
    }
    return fits;
  }

  // Number of the first block, voxel or corner of a place for a part.
  first(what, slot) { return this.own[what] + slot * this.most[what]; }

  // Middles of the coarse blocks in the lattice's space, and behind all of them where these are, both in units of half the region's size.
  middles() {
    const {keys} = this.coarse, {shell, extent, voxel, tableOrigin} = this.about.march, out = new Float32Array(2 * keys.length);
    for (let i = 0; i < keys.length; i += 3) {
      const y = [0, 1, 2].map(axis => (keys[i + axis] + tableOrigin[axis] + 0.5) * 8 * voxel - extent), n = Math.max(...y.map(Math.abs));
      out.set(y, i);
      out.set(shell && n > 1 ? times(y, shell / Math.max(extent - n, 1e-4) / n) : y, keys.length + i);
    }
    return out;
  }

  // How far the nearest block of each part is in the lattice's space; farther where it is not ahead.
  distances() {
    const {centre, halfSize, shell, extent, voxel} = this.about.march, {place, turn} = this.page.seen || this.page.view(1, 1);
    const [fx, fy, fz] = turn.slice(6), o = times(plus(place, centre, -1), 1 / halfSize), n = Math.max(...o.map(Math.abs));
    const [x, y, z] = shell && n > 1 ? times(o, (extent - shell / n) / n) : o, {middle} = this, places = middle.length / 2;
    for (const part of this.parts) {
      part.away = Infinity;
      for (let block = part.coarse[0], i = 3 * block; block < part.coarse[0] + part.coarse[1]; block++, i += 3) {
        const away = Math.hypot(middle[i] - x, middle[i + 1] - y, middle[i + 2] - z);
        if (away >= part.away) continue;
        const [dx, dy, dz] = [middle[places + i] - o[0], middle[places + i + 1] - o[1], middle[places + i + 2] - o[2]];
        const ahead = away < 8 * voxel || dx * fx + dy * fy + dz * fz > AHEAD * Math.hypot(dx, dy, dz);
        part.away = Math.min(part.away, ahead ? away : BEHIND * away);
      }
    }
  }

  look() {
    const now = performance.now();
    this.distances();
    const near = this.parts.filter(part => part.again < now).sort((a, b) => a.away - b.away).slice(0, this.slots);
    for (const part of near.filter(one => one.slot === null)) {
      if (this.parts.filter(one => one.slot !== null && !one.here).length >= AT_ONCE) break;
      if (!this.free.length) {
        const last = this.parts.filter(one => one.here).sort((a, b) => b.away - a.away)[0];
        if (!last || last.away <= STICKY * part.away) break;
        this.drop(last);
      }
      part.slot = this.free.pop();
      this.load(part).catch(() => this.fail(part));
    }
    const here = this.parts.filter(part => part.here).length;
    this.say(`details: ${here} of ${this.parts.length} parts${this.failed ? ', some cannot be loaded' : ''}`);
  }

  async load(part) {
    const answer = await fetch(`field_parts/${part.file}`);
    if (!answer.ok) throw new Error();
    const bytes = await answer.arrayBuffer(), slot = part.slot;
    const found = await this.worker({
      bytes, about: {arrays: part.arrays, table: part.table, channels: this.about.channels}, voxels: this.first('voxels', slot), corners: this.first('corners', slot),
    });
    if (found.keys.length !== 3 * part.blocks || found.densities.length !== 2 * part.voxels || found.features.length !== 4 * part.corners) throw new Error();
    for (const [name, [, format, what, each, words]] of Object.entries(LISTS))
      this.put(this.field.textures[name], format, 'UNSIGNED_INT', each * this.first(what, slot), found[name], words);
    this.fill(part, -2);
    const {ratio, about: {march, table}} = this, {keys} = found;
    for (let block = 0; block < part.blocks; block++) {
      const key = part.origin.map((v, i) => v + keys[3 * block + i]), [x, y, z] = key.map((v, i) => Math.floor(v / ratio) - march.tableOrigin[i]);
      const parent = this.coarse.table[(z * table[1] + y) * table[0] + x], own = key.map(v => v % ratio);
      this.children[((parent * ratio + own[2]) * ratio + own[1]) * ratio + own[0]] = this.first('blocks', slot) + block;
    }
    part.here = true;
    this.shown();
  }

  // Said once; what is there stays.
  fail(part) {
    this.free.push(part.slot);
    part.slot = null;
    part.again = performance.now() + AGAIN;
    if (!this.failed) brief('Some details cannot be loaded; the scene stays coarse there.');
    this.failed = true;
  }

  drop(part) {
    this.free.push(part.slot);
    part.slot = null;
    part.here = false;
    this.fill(part, -1);
    this.shown();
  }

  fill({coarse: [first, count]}, value) {
    const cube = this.ratio ** 3;
    this.children.fill(value, first * cube, (first + count) * cube);
  }

  // The picture again, over the one that is there.
  shown() {
    const {page} = this;
    this.put(this.field.textures.children, 'RED_INTEGER', 'INT', 0, this.children, 1);
    if (!page.rough && page.last) page.todo = page.last.height;
  }
}

// What unpacks parts while the page goes on: {bytes, about, voxels and corners that are before it} → arrays as `LISTS` has them, and keys.
function partWorker() {
  const unpack = async ({data: {number, bytes, about, voxels, corners}}) => {
    try {
      const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream('deflate'));
      const {keys, slices, rows, densities, feature} = unpacked(await new Response(stream).arrayBuffer(), about);
      for (let i = 2; i < slices.length; i += 4) slices[i] += voxels;
      for (let i = 1; i < rows.length; i += 2) rows[i] += corners;
      const found = {keys: keys.slice(), slices, rows, densities: new Uint32Array(densities.buffer), features: new Uint32Array(feature.buffer)};
      postMessage({number, found}, Object.values(found).map(array => array.buffer));
    } catch (error) {
      postMessage({number});
    }
  };
  const source = [arraysOf, blockTable, slicesOf, rowsOf, densitiesOf, before, guess, valuesOf, unpacked].join('\n');
  const worker = new Worker(URL.createObjectURL(new Blob([`const ONES = Uint8Array.of(${ONES.join()});\n${source}\nonmessage = ${unpack};`])));
  const waiting = new Map();
  let count = 0;
  worker.onmessage = ({data: {number, found}}) => {
    const {done, failed} = waiting.get(number);
    waiting.delete(number);
    if (found) done(found);
    else failed(new Error());
  };
  worker.onerror = () => { for (const {failed} of waiting.values()) failed(new Error()); };
  return job => new Promise((done, failed) => {
    waiting.set(++count, {done, failed});
    worker.postMessage({...job, number: count}, [job.bytes]);
  });
}
