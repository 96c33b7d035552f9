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
function before(slot, x, y, z, keys, rows, table, size) {
  const i = keys[3 * slot], j = keys[3 * slot + 1], k = keys[3 * slot + 2];
  const beside = v => v === 0 ? -1 : v === 8 ? 1 : 0, sx = beside(x), sy = beside(y), sz = beside(z);
  for (let way = 1; way < 8; way++) {
    const dx = way & 1 ? sx : 0, dy = way & 2 ? sy : 0, dz = way & 4 ? sz : 0;
    if (i + dx < 0 || j + dy < 0 || k + dz < 0 || i + dx >= size[0] || j + dy >= size[1] || k + dz >= size[2]) continue;
    const other = table[((k + dz) * size[1] + j + dy) * size[0] + i + dx];
    if (other < 0 || other >= slot) continue;
    const row = 2 * (other * 81 + (z - 8 * dz) * 9 + y - 8 * dy), below = x - 8 * dx;
    if (rows[row] >> below & 1) return rows[row + 1] + ONES[rows[row] & (1 << below) - 1];
  }
  return -1;
}

// What is predicted from the neighbours `at` (x, y, z, xy, xz, yz, xyz before it; -1: not there) in `values`, `each` bytes a corner.
function guess(values, each, offset, at, how, sides) {
  if (how === 3) {
    const near = values[each * at[0] + offset] + values[each * at[1] + offset] + values[each * at[2] + offset];
    const across = values[each * at[3] + offset] + values[each * at[4] + offset] + values[each * at[5] + offset];
    const sum = 10 * near - 5 * across + values[each * at[6] + offset] + 8 >> 4;
    return sum < 0 ? 0 : sum > 255 ? 255 : sum;
  }
  if (how < 3) {  // a plane: xy, xz or yz
    const one = at[how === 2 ? 1 : 0], two = at[how === 0 ? 1 : 2];
    const sum = 3 * (values[each * one + offset] + values[each * two + offset]) - 2 * values[each * at[3 + how] + offset] + 2 >> 2;
    return sum < 0 ? 0 : sum > 255 ? 255 : sum;
  }
  let sum = 0;
  for (let i = 0; i < 3; i++) if (at[i] >= 0) sum += values[each * at[i] + offset];
  return sides ? (2 * sum + sides) / (2 * sides) | 0 : 0;
}

// Features (16 bytes) and density of every corner: those of a block before, or what the neighbours predict and the difference from it.
function valuesOf({keys, values}, rows, corners, channels, table, size) {
  const feature = new Uint8Array(16 * corners), density = new Uint8Array(corners), written = values.length / (channels + 1);
  const place = new Int32Array(1000), near = new Int32Array(7);  // of the block's corners with a margin, and of those before one
  let to = 0, next = 0;
  for (let slot = 0; 162 * slot < rows.length; slot++) {
    place.fill(-1);
    for (let line = 0; line < 81; line++) {
      const row = rows[2 * (slot * 81 + line)], z = line / 9 | 0, y = line % 9, edge = y === 0 || y === 8 || z === 0 || z === 8;
      for (let x = 0; row >> x; x++) {
        if (!(row >> x & 1)) continue;
        const p = (z + 1) * 100 + (y + 1) * 10 + x + 1;
        const old = edge || x === 0 || x === 8 ? before(slot, x, y, z, keys, rows, table, size) : -1;
        place[p] = to;
        if (old >= 0) {
          for (let c = 0; c < channels; c++) feature[16 * to + c] = feature[16 * old + c];
          density[to++] = density[old];
          continue;
        }
        const a = near[0] = place[p - 1], b = near[1] = place[p - 10], c = near[2] = place[p - 100];
        const ab = near[3] = place[p - 11], ac = near[4] = place[p - 101], bc = near[5] = place[p - 110], abc = near[6] = place[p - 111];
        const sides = (a >= 0) + (b >= 0) + (c >= 0);
        const how = (a | b | c | ab | ac | bc | abc) >= 0 ? 3 : (a | b | ab) >= 0 ? 0 : (a | c | ac) >= 0 ? 1 : (b | c | bc) >= 0 ? 2 : 4;
        for (let c = 0; c < channels; c++) feature[16 * to + c] = guess(feature, 16, c, near, how, sides) + values[c * written + next];
        density[to] = guess(density, 1, 0, near, how, sides) + values[channels * written + next];
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
