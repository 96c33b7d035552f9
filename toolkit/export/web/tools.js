// What a visitor can do besides walking: keep views, plan a camera path, measure, crop, share. Files and links are in the input's frame.

const make = (name, values = {}, ...inside) => {
  const made = Object.assign(document.createElement(name), values);
  made.append(...inside);
  return made;
};
const PATH_SIDE = 1280;  // long side in pixels of a path's pictures
const BRIEF = 3000;  // milliseconds of a message
const CURVE = 96;  // lines that a path is drawn by
const CLICK = 5;  // pixels that a hand may move in a click
const EDGES = [0, 1, 2, 3, 4, 5, 6, 7].flatMap(a => [1, 2, 4].filter(bit => !(a & bit)).map(bit => [a, a | bit]));

class Tools {
  constructor(page) {
    const {about} = page;
    Object.assign(this, {page, frame: new Frame(about.frame), unit: about.metric ? 'm' : 'units', depth: about.depth});
    this.decimals = Math.max(0, Math.min(12, Math.ceil(4 - Math.log10(about.depth / about.frame.scale))));  // a ten-thousandth of the usual distance
    this.names = ['views', 'path', 'measure', 'crop'];
    for (const button of document.querySelectorAll('[data-opens]')) button.onclick = () => this.open(button.dataset.opens);
    this.key = `fieldfuse ${document.title} ${about.frame.shift.join(' ')}`;  // of this field in the browser's storage
    this.stored = this.remembered();
    this.points = [];
    this.region = about.region.map(corner => [...corner]);
    this.steps = [];
    this.furnishViews();
    this.furnishPath();
    this.furnishCrop();
    $('share').onclick = () => this.share();
    window.addEventListener('hashchange', () => this.arrive(400));
    this.arrive(0);
  }

  digits(value) { return String(Number(value.toFixed(this.decimals))); }

  // The panel of a tool, or none: where it was open, or `name` is null.
  open(name) {
    const opened = name && $(name).hidden ? name : null;
    for (const other of this.names) {
      $(other).hidden = other !== opened;
      document.querySelector(`[data-opens=${other}]`).setAttribute('aria-pressed', other === opened);
    }
    this.page.canvas.classList.toggle('picks', opened === 'measure');
    if (opened === 'measure') this.measured();
    this.page.over();
  }

  get measuring() { return !$('measure').hidden; }

  // ------------------------------------------------------------------------------------------------------ files, links

  // A camera as nerfstudio's camera paths have it: the vertical angle in degrees.
  camera(pose) {
    const [width, height, , fy] = this.page.photoLens;
    return {camera_to_world: this.frame.matrix(pose), fov: 360 / Math.PI * Math.atan(height / 2 / fy), aspect: width / height};
  }

  // Sides are even, as videos need them.
  size() {
    const [width, height] = this.page.photoLens, factor = PATH_SIDE / Math.max(width, height), even = v => 2 * Math.max(1, Math.round(v * factor / 2));
    return {camera_type: 'perspective', render_width: even(width), render_height: even(height)};
  }

  download(name, data) {
    const link = make('a', {href: URL.createObjectURL(new Blob([JSON.stringify(data, null, 1)], {type: 'application/json'})), download: name});
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  }

  // Cameras of a file that the visitor chooses: a path's key poses, or all that there are.
  load(use) {
    $('file').value = '';
    $('file').onchange = async () => {
      try {
        const data = JSON.parse(await $('file').files[0].text());
        const entries = (data.keyframes || data.camera_path || data.frames).slice(0, 1000);
        const found = entries.map((entry, i) => ({
          name: String(entry.file_path || `view ${i + 1}`).slice(0, 80),
          pose: this.frame.pose(entry.matrix || entry.camera_to_world || entry.transform_matrix),
        })).filter(one => one.pose);
        if (!found.length) throw new Error();
        use(found, data);
      } catch (error) {
        brief('This file holds no cameras: a camera path, or a transforms.json is expected.');
      }
    };
    $('file').click();
  }

  share() {
    const {pose, reach} = this.page.walker, turn = quaternion(pose.turn.map(axis => this.frame.columns.map(column => dot(column, axis))));
    const numbers = [...this.frame.toInput(pose.place).map(v => this.digits(v)), ...turn.map(v => Number(v.toFixed(6))), this.digits(reach / this.frame.scale)];
    history.replaceState(null, '', `#view=${numbers.join(',')}`);
    this.copy(location.href, 'The link to this view is copied.');
  }

  // To the view that the link names, if it names one.
  arrive(milliseconds) {
    const text = /^#view=([-+.,\de]+)$/i.exec(location.hash), numbers = text ? text[1].split(',').map(Number) : [];
    if (numbers.length !== 8 || !numbers.every(v => Number.isFinite(v) && Math.abs(v) < 1e9) || !(numbers[7] > 0)) return;
    const turn = turnOf(unit(numbers.slice(3, 7))).map(axis => this.frame.rows.map(row => dot(row, axis)));
    this.page.go({turn, place: this.frame.toWorking(numbers.slice(0, 3))}, numbers[7] * this.frame.scale, milliseconds);
  }

  async copy(text, done) {
    try {
      await navigator.clipboard.writeText(text);
    } catch (error) {  // where a page from the disk may not
      const area = make('textarea', {value: text});
      document.body.append(area);
      area.select();
      document.execCommand('copy');
      area.remove();
    }
    brief(done);
  }

  // ------------------------------------------------------------------------------------------------------- saved views

  remembered() {
    try {
      return JSON.parse(localStorage.getItem(this.key)).filter(one => typeof one.name === 'string' && this.frame.pose(one.camera_to_world)).slice(0, 1000);
    } catch (error) {
      return [];
    }
  }

  furnishViews() {
    document.querySelector('#views form').onsubmit = event => {
      event.preventDefault();
      const {pose, reach} = this.page.walker, name = $('title').value.trim() || `View ${this.stored.length + 1}`;
      this.stored.push({...this.camera(pose), name, reach: reach / this.frame.scale});
      $('title').value = '';
      this.listViews();
    };
    $('views-save').onclick = () => this.download('views.json', {
      ...this.size(), camera_path: this.stored.map(({name, reach, ...camera}) => ({...camera, file_path: name})),
    });
    $('views-load').onclick = () => this.load(found => {
      this.stored.push(...found.map(({name, pose}) => ({...this.camera(pose), name, reach: this.depth / this.frame.scale})));
      this.listViews();
    });
    this.listViews();
  }

  listViews() {
    document.querySelector('#views ul').replaceChildren(...this.stored.map((one, i) => make('li', {},
      make('button', {textContent: one.name, onclick: () => this.page.go(this.frame.pose(one.camera_to_world), (one.reach || 1) * this.frame.scale, 500)}),
      make('button', {textContent: '✕', title: `Delete ${one.name}`, ariaLabel: `Delete ${one.name}`, onclick: () => { this.stored.splice(i, 1); this.listViews(); }}))));
    $('views-save').disabled = !this.stored.length;
    try {
      localStorage.setItem(this.key, JSON.stringify(this.stored));
    } catch (error) {  // no storage: they last as long as the page, and can be downloaded
    }
  }

  // ------------------------------------------------------------------------------------------------------- camera path

  furnishPath() {
    $('add').onclick = () => { this.steps.push(this.page.walker.pose); this.listPath(); };
    $('clear').onclick = () => { this.steps = []; this.listPath(); };
    $('play').onclick = () => this.page.fly(this.page.flight === null ? this.flight() : null);
    $('path-save').onclick = () => this.download('camera_path.json', this.path());
    $('closed').onchange = () => this.page.over();
    $('path-load').onclick = () => this.load((found, data) => {
      this.steps = found.map(one => one.pose);
      for (const [id, value] of [['seconds', data.seconds], ['fps', data.fps]]) if (value > 0) $(id).value = value;
      $('closed').checked = Boolean(data.is_cycle);
      this.listPath();
    });
  }

  listPath() {
    document.querySelector('#path ol').replaceChildren(...this.steps.map((pose, i) => make('li', {},
      make('button', {textContent: `View ${i + 1}`, onclick: () => this.page.go(pose, this.depth, 500)}),
      make('button', {textContent: 'Set', title: 'Put it where you are now', onclick: () => { this.steps[i] = this.page.walker.pose; this.listPath(); }}),
      make('button', {textContent: '✕', title: `Delete view ${i + 1}`, ariaLabel: `Delete view ${i + 1}`, onclick: () => { this.steps.splice(i, 1); this.listPath(); }}))));
    for (const id of ['play', 'clear', 'path-save']) $(id).disabled = !this.steps.length;
    this.page.fly(null);
    this.page.over();
  }

  get seconds() { return Math.max(0.1, Math.min(3600, Number($('seconds').value) || 10)); }

  flight() {
    const route = new Route(this.steps, $('closed').checked);
    return {at: share => route.at(share), seconds: this.seconds, button: 'play', word: 'Play'};
  }

  path() {
    const fps = Math.max(1, Math.min(120, Number($('fps').value) || 30)), count = Math.max(1, Math.round(fps * this.seconds));
    const closed = $('closed').checked, route = new Route(this.steps, closed), parts = closed ? count : Math.max(1, count - 1);
    const keyframes = this.steps.map(pose => {
      const {camera_to_world: matrix, ...rest} = this.camera(pose);
      return {matrix, ...rest};
    });
    return {
      keyframes, ...this.size(), fps, seconds: this.seconds, is_cycle: closed,
      camera_path: Array.from({length: count}, (_, i) => this.camera(route.at(i / parts))),
    };
  }

  // ---------------------------------------------------------------------------------------------------------- measuring

  pick(x, y) {
    const point = this.page.pick(x, y);
    if (!point) return brief('Nothing solid is there.');
    this.points = this.points.length === 2 ? [point] : [...this.points, point];
    this.measured();
    this.page.over();
  }

  get length() { return Math.hypot(...plus(this.points[1], this.points[0], -1)) / this.frame.scale; }

  get lengthText() {
    const length = this.length;
    if (this.unit !== 'm') return `${Number(length.toPrecision(4))} ${this.unit}`;
    return length < 0.1 ? `${Number((1000 * length).toPrecision(3))} mm` : length < 1 ? `${Number((100 * length).toPrecision(3))} cm` : `${Number(length.toPrecision(4))} m`;
  }

  measured() {
    $('length').textContent = this.points.length === 2 ? this.lengthText : this.points.length ? 'Click the second point.' : 'Click two points.';
  }

  // --------------------------------------------------------------------------------------------------------------- crop

  furnishCrop() {
    $('box').replaceChildren(...['x', 'y', 'z'].flatMap((name, axis) => [make('span', {textContent: name}), ...['from', 'to'].map((word, side) => make('input', {
      type: 'number', step: 'any', ariaLabel: `${name} ${word}`, id: `${name}${side}`,
      onchange: event => this.bound(axis, side, Number(event.target.value), true),
    }))]));
    $('cut').onchange = () => this.cropped();
    $('all').onclick = () => { this.region = this.page.about.region.map(corner => [...corner]); this.cropped(); };
    $('copy').onclick = () => this.copy($('numbers').textContent, 'Copied.');
    this.cropped();
  }

  // Move one face; a box has some size.
  bound(axis, side, value, typed) {
    const [low, high] = this.page.about.region, least = 1e-3 * (high[axis] - low[axis]), other = this.region[1 - side][axis];
    if (Number.isFinite(value)) this.region[side][axis] = side ? Math.max(value, other + least) : Math.min(value, other - least);
    if (typed) $('cut').checked = true;
    this.cropped();
  }

  cropped() {
    ['x', 'y', 'z'].forEach((name, axis) => [0, 1].forEach(side => { $(`${name}${side}`).value = this.digits(this.region[side][axis]); }));
    this.region = this.region.map(corner => corner.map(v => Number(this.digits(v))));
    $('numbers').textContent = `--crop "${this.region.flat().map(v => this.digits(v)).join(',')}"`;
    this.page.crop = $('cut').checked ? this.box() : null;
    this.page.move();
    this.page.over();
  }

  // From the shader's coordinates to the box between -1 and 1: a matrix, column by column, and a shift.
  box() {
    const {centre, halfSize} = this.page.about.march, [low, high] = this.region, half = low.map((v, i) => (high[i] - v) / 2);
    const at = this.frame.toInput(centre), scale = halfSize / this.frame.scale;
    return {
      turn: [0, 1, 2].flatMap(column => [0, 1, 2].map(row => this.frame.columns[row][column] * scale / half[row])),
      shift: at.map((v, i) => (v - low[i]) / half[i] - 1),
    };
  }

  corner(number) { return this.frame.toWorking([0, 1, 2].map(axis => this.region[number >> axis & 1][axis])); }

  face(axis, side) { return this.frame.toWorking([0, 1, 2].map(i => i === axis ? this.region[side][i] : (this.region[0][i] + this.region[1][i]) / 2)); }

  // ---------------------------------------------------------------------------------------------- what is drawn over it

  // SVG of lines between points of the working frame, cut where they come behind the camera, by the page's `project`.
  drawn(project) {
    const line = (a, b) => {
      const [p, q] = project(a, b);
      return p ? `<line x1="${p[0]}" y1="${p[1]}" x2="${q[0]}" y2="${q[1]}"/>` : '';
    };
    const dot = (point, more = '', size = 5) => {
      const [p] = project(point, point);
      return p ? `<circle cx="${p[0]}" cy="${p[1]}" r="${size}"${more}/>` : '';
    };
    let out = '';
    if (!$('measure').hidden && this.points.length) {
      out += this.points.map(point => dot(point)).join('');
      if (this.points.length === 2) {
        const [p] = project(...Array(2).fill(times(plus(...this.points), 0.5)));
        out += line(...this.points) + (p ? `<text x="${p[0]}" y="${p[1] - 12}">${this.lengthText}</text>` : '');
      }
    }
    if (!$('path').hidden && this.steps.length > 1) {
      const route = new Route(this.steps, $('closed').checked), places = Array.from({length: CURVE + 1}, (_, i) => route.at(i / CURVE).place);
      out += places.slice(1).map((place, i) => line(places[i], place)).join('') + this.steps.map(pose => dot(pose.place)).join('');
    }
    if (!$('crop').hidden) {
      out += EDGES.map(([a, b]) => line(this.corner(a), this.corner(b))).join('');
      out += [0, 1, 2].flatMap(axis => [0, 1].map(side => dot(this.face(axis, side), ` data-face="${axis} ${side}"`, 8))).join('');
    }
    return out;
  }

  // A face follows the hand along its axis, as that is seen.
  drag(face, by, project) {
    const [axis, side] = face, length = this.region[1][axis] - this.region[0][axis], here = this.face(axis, side);
    const step = plus(here, this.frame.rows.map(row => row[axis]), 0.1 * length * this.frame.scale), [p] = project(here, here), [q] = project(step, step);
    if (!p || !q) return;
    const way = [q[0] - p[0], q[1] - p[1]], square = way[0] * way[0] + way[1] * way[1];
    if (square > 1) this.bound(axis, side, this.region[side][axis] + 0.1 * length * (way[0] * by[0] + way[1] * by[1]) / square, true);
  }
}
