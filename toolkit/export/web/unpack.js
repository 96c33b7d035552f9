// From the page's own bytes to arrays for the graphics card. Only what cannot be worked out is in the page: which voxels there are, a byte
// of density and sixteen of features a corner, as differences (`export/corners.py`). Places of voxels and corners follow by counting, as
// `render/bake.py` counted them.

const ONES = Uint8Array.from({length: 512}, (_, n) => { let count = 0; for (; n; n &= n - 1) count++; return count; });

async function inflated(text) {
  const binary = atob(text.trim());
  const bytes = new Uint8Array(binary.length);
  for (let i = 0; i < bytes.length; i++) bytes[i] = binary.charCodeAt(i);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream('deflate'));
  return new Response(stream).arrayBuffer();
}

// {name: typed array} by the list of [name, type, length] that the arrays lie in.
function arraysOf(buffer, list) {
  const kinds = {u1: Uint8Array, u2: Uint16Array, f4: Float32Array}, out = {};
  let offset = 0;
  for (const [name, kind, length] of list) {
    out[name] = new kinds[kind](buffer, offset, length);
    offset += Math.ceil(length * kinds[kind].BYTES_PER_ELEMENT / 4) * 4;
  }
  if (offset !== buffer.byteLength) throw new Error('the field in this page is damaged');
  return out;
}

// Block of voxels at every place of the table (z slowest), -1: none.
function blockTable(keys, size) {
  const table = new Int32Array(size[0] * size[1] * size[2]).fill(-1);
  for (let slot = 0; 3 * slot < keys.length; slot++)
    table[(keys[3 * slot + 2] * size[1] + keys[3 * slot + 1]) * size[0] + keys[3 * slot]] = slot;
  return table;
}

// For every z-slice of a block: two words of occupancy and how many voxels are before it, as (…, 4) words.
function slicesOf(bits) {
  const words = new Uint32Array(bits.buffer, bits.byteOffset, bits.length / 4), slices = new Uint32Array(words.length * 2);
  let voxels = 0;
  for (let i = 0; 2 * i < words.length; i++) {
    slices[4 * i] = words[2 * i];
    slices[4 * i + 1] = words[2 * i + 1];
    slices[4 * i + 2] = voxels;
    for (let y = 0; y < 8; y++) voxels += ONES[bits[8 * i + y]];
  }
  return {slices, voxels};
}

// For every row of a block's 9 × 9 rows of corners: which of its nine are stored, and how many are before it, as (…, 2) words.
function rowsOf(bits) {
  const blocks = bits.length / 64, rows = new Uint32Array(blocks * 162);
  let corners = 0;
  for (let slot = 0; slot < blocks; slot++) {
    for (let z = 0; z < 8; z++) for (let y = 0; y < 8; y++) {
      const row = bits[(slot * 8 + z) * 8 + y];
      if (!row) continue;
      const both = row | row << 1;
      for (const at of [z * 9 + y, z * 9 + y + 1, (z + 1) * 9 + y, (z + 1) * 9 + y + 1]) rows[2 * (slot * 81 + at)] |= both;
    }
    for (let at = slot * 81; at < (slot + 1) * 81; at++) {
      rows[2 * at + 1] = corners;
      corners += ONES[rows[2 * at]];
    }
  }
  return {rows, corners};
}

// Eight densities of every voxel next to each other, x fastest, so that a sample is one look.
function densitiesOf(bits, rows, density, voxels) {
  const eight = new Uint8Array(8 * voxels);
  let to = 0;
  for (let line = 0; line < bits.length; line++) {
    const row = bits[line];
    if (!row) continue;
    const slot = line >> 6, z = line >> 3 & 7, y = line & 7;
    for (let x = 0; x < 8; x++) {
      if (!(row >> x & 1)) continue;
      for (let pair = 0; pair < 4; pair++) {
        const at = 2 * (slot * 81 + (z + (pair >> 1)) * 9 + y + (pair & 1));
        const from = rows[at + 1] + ONES[rows[at] & (1 << x) - 1];
        eight[to++] = density[from];
        eight[to++] = density[from + 1];
      }
    }
  }
  return eight;
}

// The same corner in a block before this one, -1: there is none.
function before(slot, at, given, rows, table, size) {
  const [x, y, z] = at, [i, j, k] = given.keys.subarray(3 * slot, 3 * slot + 3);
  const beside = v => v === 0 ? [0, -1] : v === 8 ? [0, 1] : [0];
  for (const dz of beside(z)) for (const dy of beside(y)) for (const dx of beside(x)) {
    const inside = i + dx >= 0 && j + dy >= 0 && k + dz >= 0 && i + dx < size[0] && j + dy < size[1] && k + dz < size[2];
    const other = inside ? table[((k + dz) * size[1] + j + dy) * size[0] + i + dx] : -1;
    if (other < 0 || other >= slot) continue;
    const row = 2 * (other * 81 + (z - 8 * dz) * 9 + y - 8 * dy), below = x - 8 * dx;
    if (rows[row] >> below & 1) return rows[row + 1] + ONES[rows[row] & (1 << below) - 1];
  }
  return -1;
}

// Features (16 bytes) and density of every corner: those of a block before, or what the neighbours predict and the difference from it.
function valuesOf(given, rows, corners, channels, table, size) {
  const feature = new Uint8Array(16 * corners), density = new Uint8Array(corners), written = given.values.length / (channels + 1);
  const planes = Array.from({length: channels + 1}, (_, c) => c < channels ? [feature, 16, c] : [density, 1, 0]);
  const place = new Int32Array(1000), by = [1, 10, 100, 11, 101, 110, 111];  // in x, y, z, and in several of them
  const near = new Int32Array(7);
  let to = 0, next = 0;
  for (let slot = 0; 81 * slot < rows.length / 2; slot++) {
    place.fill(-1);
    for (let line = 0; line < 81; line++) {
      const row = rows[2 * (slot * 81 + line)], z = line / 9 | 0, y = line % 9;
      for (let x = 0; row >> x; x++) {
        if (!(row >> x & 1)) continue;
        const p = (z + 1) * 100 + (y + 1) * 10 + x + 1, edge = x % 8 === 0 || y % 8 === 0 || z % 8 === 0;
        const old = edge ? before(slot, [x, y, z], given, rows, table, size) : -1;
        place[p] = to;
        if (old >= 0) {
          feature.copyWithin(16 * to, 16 * old, 16 * old + 16);
          density[to++] = density[old];
          continue;
        }
        let all = true, sides = 0;
        for (let i = 0; i < 7; i++) {
          near[i] = place[p - by[i]];
          if (near[i] < 0) all = false;
          else if (i < 3) sides++;
        }
        const flat = [[0, 1, 3], [0, 2, 4], [1, 2, 5]].find(three => three.every(i => near[i] >= 0));
        for (let c = 0; c <= channels; c++) {
          const [values, each, offset] = planes[c], of = i => values[near[i] * each + offset];
          let guess = 0;
          if (all) guess = 10 * (of(0) + of(1) + of(2)) - 5 * (of(3) + of(4) + of(5)) + of(6) + 8 >> 4;
          else if (flat) guess = 3 * (of(flat[0]) + of(flat[1])) - 2 * of(flat[2]) + 2 >> 2;
          else if (sides) {
            for (let i = 0; i < 3; i++) if (near[i] >= 0) guess += of(i);
            guess = (2 * guess + sides) / (2 * sides) | 0;
          }
          values[to * each + offset] = Math.max(0, Math.min(255, guess)) + given.values[c * written + next];
        }
        next++;
        to++;
      }
    }
  }
  if (next !== written) throw new Error('the field in this page is damaged');
  return {feature, density};
}

function unpacked(buffer, about) {
  const given = arraysOf(buffer, about.arrays);
  const {slices, voxels} = slicesOf(given.bits), {rows, corners} = rowsOf(given.bits), table = blockTable(given.keys, about.table);
  const {feature, density} = valuesOf(given, rows, corners, about.channels, table, about.table);
  return {...given, slices, rows, densities: densitiesOf(given.bits, rows, density, voxels), feature, voxels, table};
}
