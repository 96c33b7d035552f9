// From the page's own bytes to arrays for the graphics card. Only what cannot be worked out is in the page: which voxels there are, a byte
// of density and sixteen of features a corner. Places of voxels and corners follow by counting, as `render/bake.py` counted them.

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

function unpacked(buffer, about) {
  const given = arraysOf(buffer, about.arrays);
  const {slices, voxels} = slicesOf(given.bits), {rows, corners} = rowsOf(given.bits);
  if (corners !== given.density.length) throw new Error('the field in this page is damaged');
  const densities = densitiesOf(given.bits, rows, given.density, voxels);
  return {...given, slices, rows, densities, voxels, table: blockTable(given.keys, about.table)};
}
