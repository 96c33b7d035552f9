// The field on the graphics card: what it is given once, and pictures of it, each drawn strip by strip so that no strip takes long.

const FULL = `#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0, 1); }`;
const COPY = `uniform sampler2D picture; uniform vec2 size, corner; out vec4 shown;
void main() { shown = vec4(texture(picture, (gl_FragCoord.xy - corner) / size).rgb, 1); }`;
const WIDTH_BITS = 12;
const MOST_TARGETS = 8;

class Field {
  constructor(gl, about, shaders, field) {
    this.gl = gl;
    this.about = about;
    const define = {...about.define, WIDTH_BITS}, head = ['#version 300 es', 'precision highp float;', 'precision highp int;']
      .concat(Object.entries(define).map(([name, value]) => `#define ${name} ${value}`)).join('\n') + '\n';
    this.march = this.program(head + shaders.march);
    this.decode = this.program(head + shaders.decode);
    this.copy = this.program(head + COPY);
    const small = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    if (small < 1 << WIDTH_BITS) throw new Error('this device takes no pictures of 4096 pixels, which the field needs');
    this.textures = {
      blocks: this.cube(gl.R32I, gl.RED_INTEGER, gl.INT, field.table, about.table),
      bricks: this.cube(gl.R8UI, gl.RED_INTEGER, gl.UNSIGNED_BYTE, field.bricks, Array(3).fill(about.side)),
      slices: this.list(gl.RGBA32UI, gl.RGBA_INTEGER, gl.UNSIGNED_INT, field.slices, 4),
      densities: this.list(gl.RG32UI, gl.RG_INTEGER, gl.UNSIGNED_INT, new Uint32Array(field.densities.buffer), 2),
      rows: this.list(gl.RG32UI, gl.RG_INTEGER, gl.UNSIGNED_INT, field.rows, 2),
      features: this.list(gl.RGBA32UI, gl.RGBA_INTEGER, gl.UNSIGNED_INT, wordsOf(field.feature), 4),
      thickness: this.list(gl.R32F, gl.RED, gl.FLOAT, field.thickness, 1),
    };
    this.palette = this.texture(gl.TEXTURE_2D, gl.LINEAR);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, 256, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, field.palette);
    this.block(this.decode, 'Small', field.small, 0);
    const third = field.large.length / 3;
    for (let part = 0; part < 3; part++) this.block(this.decode, `Large${part}`, field.large.subarray(part * third, (part + 1) * third), 1 + part);
    gl.useProgram(this.march.program);
    for (const [name, value] of Object.entries(about.march)) this.set(this.march, name, value);
    gl.useProgram(this.decode.program);
    gl.uniform3fv(this.decode.at('sky'), about.sky);
    gl.uniform1f(this.decode.at('exposure'), about.exposure);
    this.targets = new Map();
  }

  program(fragment) {
    const gl = this.gl, program = gl.createProgram();
    const refuse = why => { throw new Error(`this device cannot draw the field (${why})`); };
    for (const [kind, source] of [[gl.VERTEX_SHADER, FULL], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) refuse(gl.getShaderInfoLog(shader));
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) refuse(gl.getProgramInfoLog(program));
    const places = new Map();
    const at = name => {
      if (!places.has(name)) places.set(name, gl.getUniformLocation(program, name));
      return places.get(name);
    };
    return {program, at};
  }

  set(of, name, value) {
    const gl = this.gl, at = of.at(name);
    if (name === 'tableOrigin') gl.uniform3iv(at, value);
    else if (!Array.isArray(value)) gl.uniform1f(at, value);
    else if (value.length === 3) gl.uniform3fv(at, value);
    else gl.uniform4fv(at, value);
  }

  texture(kind, filter) {
    const gl = this.gl, made = gl.createTexture();
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(kind, made);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(kind, name, filter);
    for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(kind, name, gl.CLAMP_TO_EDGE);
    return made;
  }

  cube(inside, format, type, values, [x, y, z]) {
    const gl = this.gl, made = this.texture(gl.TEXTURE_3D, gl.NEAREST);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.texImage3D(gl.TEXTURE_3D, 0, inside, x, y, z, 0, format, type, values);
    return made;
  }

  // A long list as a picture of 4096 entries a line.
  list(inside, format, type, values, each) {
    const gl = this.gl, made = this.texture(gl.TEXTURE_2D, gl.NEAREST), width = 1 << WIDTH_BITS, count = values.length / each;
    const height = Math.max(1, Math.ceil(count / width)), whole = Math.floor(count / width), left = count - whole * width;
    if (height > gl.getParameter(gl.MAX_TEXTURE_SIZE)) throw new Error('the field is larger than what this device can draw');
    gl.texStorage2D(gl.TEXTURE_2D, 1, inside, width, height);
    if (whole) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, width, whole, format, type, values);
    if (left) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, whole, left, 1, format, type, values.subarray(whole * width * each));
    return made;
  }

  block(of, name, values, number) {
    const gl = this.gl, made = gl.createBuffer();
    gl.bindBufferBase(gl.UNIFORM_BUFFER, number, made);
    gl.bufferData(gl.UNIFORM_BUFFER, values, gl.STATIC_DRAW);
    gl.uniformBlockBinding(of.program, gl.getUniformBlockIndex(of.program, name), number);
  }

  // Where a picture of this size is drawn: three of words that the march leaves, and one of colours.
  target(width, height) {
    const key = `${width} ${height}`, gl = this.gl;
    const kept = this.targets.get(key);
    if (kept) {
      this.targets.delete(key);  // the last in the row is the one that was used last
      this.targets.set(key, kept);
      return kept;
    }
    if (this.targets.size === MOST_TARGETS) {  // windows change their size, pictures in motion theirs
      const [name, old] = this.targets.entries().next().value;
      [...old.words, old.picture].forEach(one => gl.deleteTexture(one));
      [old.marched, old.decoded].forEach(one => gl.deleteFramebuffer(one));
      this.targets.delete(name);
    }
    const made = {width, height, words: [], marched: gl.createFramebuffer(), decoded: gl.createFramebuffer()};
    gl.bindFramebuffer(gl.FRAMEBUFFER, made.marched);
    for (let i = 0; i < 3; i++) {
      made.words.push(this.texture(gl.TEXTURE_2D, gl.NEAREST));
      gl.texStorage2D(gl.TEXTURE_2D, 1, i === 2 ? gl.RG32UI : gl.RGBA32UI, width, height);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + i, gl.TEXTURE_2D, made.words[i], 0);
    }
    gl.drawBuffers([0, 1, 2].map(i => gl.COLOR_ATTACHMENT0 + i));
    if (gl.checkFramebufferStatus(gl.FRAMEBUFFER) !== gl.FRAMEBUFFER_COMPLETE) throw new Error('this device cannot draw the field (no room for its words)');
    gl.bindFramebuffer(gl.FRAMEBUFFER, made.decoded);
    made.picture = this.texture(gl.TEXTURE_2D, gl.LINEAR);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA8, width, height);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, made.picture, 0);
    this.targets.set(key, made);
    return made;
  }

  bind(of, textures) {
    const gl = this.gl;
    Object.entries(textures).forEach(([name, texture], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(name === 'blocks' || name === 'bricks' ? gl.TEXTURE_3D : gl.TEXTURE_2D, texture);
      gl.uniform1i(of.at(name), unit);
    });
  }

  // Lines `from` … `to` (from below) of the picture that `view` shows: {turn: 9 numbers, column by column, place, lens, show, range, crop}.
  strip(target, view, from, to) {
    const gl = this.gl, {width, height} = target;
    gl.viewport(0, 0, width, height);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(0, from, width, to - from);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.marched);
    gl.useProgram(this.march.program);
    this.bind(this.march, this.textures);
    gl.uniform3fv(this.march.at('place'), view.place);
    if (view.crop) {
      gl.uniformMatrix3fv(this.march.at('cropTurn'), false, view.crop.turn);
      gl.uniform3fv(this.march.at('cropShift'), view.crop.shift);
    }
    this.look(this.march, view, width, height);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    this.colour(target, view);
    gl.disable(gl.SCISSOR_TEST);
  }

  look(of, view, width, height) {
    const gl = this.gl;
    gl.uniformMatrix3fv(of.at('turn'), false, view.turn);
    gl.uniform4fv(of.at('lens'), view.lens);
    gl.uniform2f(of.at('size'), width, height);
    gl.uniform1i(of.at('cropped'), view.crop ? 1 : 0);
  }

  colour(target, view) {
    const gl = this.gl, [first, second, rest] = target.words;
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.decoded);
    gl.useProgram(this.decode.program);
    this.bind(this.decode, {first, second, rest, palette: this.palette});
    this.look(this.decode, view, target.width, target.height);
    gl.uniform1i(this.decode.at('show'), view.show);
    gl.uniform2fv(this.decode.at('range'), view.range);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // The picture of a target, made as large as another one, or as the page (null), or a part {decoded, x, y, width, height} of what a headset shows.
  put(target, onto) {
    const gl = this.gl, {x = 0, y = 0, width, height} = onto || {width: gl.drawingBufferWidth, height: gl.drawingBufferHeight};
    gl.bindFramebuffer(gl.FRAMEBUFFER, onto ? onto.decoded : null);
    gl.viewport(x, y, width, height);
    gl.useProgram(this.copy.program);
    this.bind(this.copy, {picture: target.picture});
    gl.uniform2f(this.copy.at('size'), width, height);
    gl.uniform2f(this.copy.at('corner'), x, y);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // Depth along z and opacity at a pixel (from below); waits for what was drawn.
  told(target, x, y) {
    const gl = this.gl, words = new Uint32Array(4);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.marched);
    gl.readBuffer(gl.COLOR_ATTACHMENT2);
    gl.readPixels(x, y, 1, 1, gl.RGBA_INTEGER, gl.UNSIGNED_INT, words);
    return new Float32Array(words.buffer);
  }
}

function wordsOf(bytes) {
  return bytes.byteOffset % 4 ? new Uint32Array(bytes.slice().buffer) : new Uint32Array(bytes.buffer, bytes.byteOffset, bytes.length / 4);
}
