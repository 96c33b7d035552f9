// One ray a pixel through the baked field: what `backends/numba/march.py` does, in the same order and with the same numbers.
// Out come the mean features of the ray (halves, two to a word), its depth and its opacity.

uniform highp isampler3D blocks;     // block of 8³ voxels at a place of the table, -1: none
uniform highp usampler3D bricks;     // distance in bricks of 4³ voxels to the nearest that holds something, with a margin of one
uniform highp usampler2D slices;     // a z-slice of a block: which voxels it holds (two words), how many voxels are before it
uniform highp usampler2D densities;  // a voxel: the quantised raw densities of its eight corners
uniform highp usampler2D rows;       // a row of a block's corners: which are stored, how many are before it
uniform highp usampler2D features;   // a corner: sixteen bytes
uniform highp sampler2D thickness;   // by raw density in sixteenths of its steps
//% if parts
uniform highp isampler2D children;  // of a block: its RATIO³ blocks of the finer lattice, -1: not loaded, -2: nothing is there
//% endif
uniform vec3 centre, box, place;
uniform ivec3 tableOrigin;
uniform float halfSize, shell, extent, voxel, near;
uniform vec4 lens, low[4], scale[4];  // fx, fy, cx, cy
uniform mat3 turn;                    // world from camera
uniform vec2 size;
uniform bool cropped;    // only what lies in a box is shown:
uniform mat3 cropTurn;   // to coordinates that are between -1 and 1 in it
uniform vec3 cropShift;

layout(location = 0) out uvec4 first;
layout(location = 1) out uvec4 second;
layout(location = 2) out uvec2 rest;

const float STOP = 1e-2, THRESHOLD = 5e-3, STRETCH = MAX_STRETCH;

ivec2 at(int i) { return ivec2(i & (1 << WIDTH_BITS) - 1, i >> WIDTH_BITS); }

int ones(uint v) {
  v = v - ((v >> 1) & 0x55555555u);
  v = (v & 0x33333333u) + ((v >> 2) & 0x33333333u);
  return int(((v + (v >> 4) & 0x0F0F0F0Fu) * 0x01010101u) >> 24);
}

vec4 bytes(uint word) { return vec4(word & 255u, (word >> 8) & 255u, (word >> 16) & 255u, word >> 24); }

// Past what is at infinity: `volume/space.py`.
vec3 contracted(vec3 y, float n) { return y * (n > 1.0 ? (extent - shell / n) / n : 1.0) + extent; }

float norm(vec3 y) { return max(max(abs(y.x), abs(y.y)), max(abs(y.z), 1.0)); }

void add(inout vec4 mean[4], int corner, float weight) {
  uvec4 word = texelFetch(features, at(corner), 0);
  mean[0] += weight * bytes(word.x);
  mean[1] += weight * bytes(word.y);
  mean[2] += weight * bytes(word.z);
  mean[3] += weight * bytes(word.w);
}

void colour(inout vec4 mean[4], int slot, ivec3 cell, vec3 f, float weight) {
  uint below = (1u << cell.x) - 1u;
  for (int pair = 0; pair < 4; pair++) {
    int dy = pair & 1, dz = pair >> 1;
    uvec2 row = texelFetch(rows, at(slot * 81 + (cell.z + dz) * 9 + cell.y + dy), 0).xy;
    int corner = int(row.y) + ones(row.x & below);
    float share = weight * (dy == 1 ? f.y : 1.0 - f.y) * (dz == 1 ? f.z : 1.0 - f.z);
    add(mean, corner, share * (1.0 - f.x));
    add(mean, corner + 1, share * f.x);
  }
}

//% if parts
// The block of a lattice RATIO times as fine, or the coarse one where that is not loaded, and by how much it is finer than this lattice;
// -1 where nothing is.
ivec2 blockAt(ivec3 fine) {
  ivec3 whole = fine / RATIO - tableOrigin, own = fine & RATIO - 1;
  bool inside = all(greaterThanEqual(whole, ivec3(0))) && all(lessThan(whole, textureSize(blocks, 0)));
  int slot = inside ? texelFetch(blocks, whole, 0).x : -1;
  if (slot < 0) return ivec2(-1, RATIO);
  int child = texelFetch(children, at(((slot * RATIO + own.z) * RATIO + own.y) * RATIO + own.x), 0).x;
  return child == -1 ? ivec2(slot, 1) : ivec2(child, RATIO);
}

ivec3 fineBlock(vec3 p) { return ivec3(clamp(p / voxel, vec3(0), vec3(float(RESOLUTION) - 1e-3)) * float(RATIO)) >> 3; }
//% endif
// Where a ray enters a box of half size `box` about zero, and where it leaves it.
vec2 through(vec3 o, vec3 d, vec3 box) {
  vec3 way = mix(d, vec3(1e-9), lessThan(abs(d), vec3(1e-9)));
  vec3 a = (-box - o) / way, b = (box - o) / way, enter = min(a, b), leave = max(a, b);
  return vec2(max(enter.x, max(enter.y, enter.z)), min(leave.x, min(leave.y, leave.z)));
}

void main() {
  vec2 pixel = (vec2(gl_FragCoord.x, size.y - gl_FragCoord.y) - lens.zw) / lens.xy;
  float cosine = inversesqrt(dot(pixel, pixel) + 1.0);
  vec3 d = turn * vec3(pixel, 1.0) * cosine;
  vec3 o = (place - centre) / halfSize;
  float coarse = voxel * 4.0, s = near / halfSize, start = s, leave = 3e38, rise = 0.0;
  if (shell == 0.0) {
    vec2 inside = through(o, d, box);
    s = max(s, inside.x);
    leave = inside.y;
  } else {
    vec3 p = o - dot(o, d) * d;
    rise = inversesqrt(shell * shell + extent * extent * dot(p, p));
  }
  if (cropped) {
    vec2 inside = through(cropTurn * o + cropShift, cropTurn * d, vec3(1));
    s = max(s, inside.x);
    leave = min(leave, inside.y);
  }
  float far = shell / voxel, light = 1.0, median = 0.0, total = 0.0;
  float most = float(RESOLUTION) - 1e-3;
  vec4 mean[4] = vec4[4](vec4(0), vec4(0), vec4(0), vec4(0));
  ivec3 last = ivec3(-1), tableSize = textureSize(blocks, 0);
  int slot = -1, top = textureSize(bricks, 0).x - 1;
  bool known = false;
  //% if parts
  float finer = 1.0;
  //% endif
  vec3 p0 = vec3(0);
  for (int turnOf = 0; turnOf < LONGEST; turnOf++) {
    vec3 y = o + s * d;
    float n = 1.0, s1;
    if (s >= leave) break;
    if (shell == 0.0) s1 = s + coarse;
    else {
      n = norm(y);
      if (n > far) break;
      s1 = s + coarse * clamp(n * n * rise, 1.0, STRETCH);
    }
    s1 = min(s1, leave);
    if (!known) p0 = contracted(y, n);
    y = o + s1 * d;
    vec3 p1 = contracted(y, shell == 0.0 ? 1.0 : norm(y));
    ivec3 brick = clamp(ivec3(0.5 * (p0 + p1) / (4.0 * voxel) + 1.0), ivec3(0), ivec3(top));
    int gap = int(texelFetch(bricks, brick, 0).x);
    if (gap > 1) {  // what is so many bricks away is not beside the middle of the steps before
      known = gap == 2;
      p0 = p1;
      s = s1;
      if (gap > 2 && shell == 0.0) s += float(gap - 2) * coarse;
      else for (int skip = 2; skip < gap; skip++) {
        n = norm(o + s * d);
        s += coarse * clamp(n * n * rise, 1.0, STRETCH);
      }
      continue;
    }
    if (s1 > start) {
      vec3 way = p1 - p0;
      //% if parts
      int steps = COARSE_STEPS * max(blockAt(fineBlock(p0)).y, blockAt(fineBlock(p1)).y);
      //% endif
      float length_ = length(way) / float(FINE);
      for (int i = 0; i < FINE; i++) {
        vec3 x = clamp((p0 + way * ((float(i) + 0.5) / float(FINE))) / voxel, vec3(0), vec3(most));
        //% if parts
        ivec3 block = ivec3(x * float(RATIO)) >> 3;
        if (block != last) {
          last = block;
          ivec2 found = blockAt(block);
          slot = found.x;
          finer = float(found.y);
        }
        x *= finer;
        ivec3 cell = ivec3(x);
        //% else
        ivec3 cell = ivec3(x), block = (cell >> 3) - tableOrigin;
        if (block != last) {
          last = block;
          bool inside = all(greaterThanEqual(block, ivec3(0))) && all(lessThan(block, tableSize));
          slot = inside ? texelFetch(blocks, block, 0).x : -1;
        }
        //% endif
        if (slot < 0) continue;
        ivec3 own = cell & 7;
        uvec4 slice = texelFetch(slices, at(slot * 8 + own.z), 0);
        uint bit = 1u << ((own.y & 3) * 8 + own.x), word = own.y < 4 ? slice.x : slice.y;
        if ((word & bit) == 0u) continue;
        int number = int(slice.z) + ones(word & (bit - 1u)) + (own.y < 4 ? 0 : ones(slice.x));
        vec3 f = x - vec3(cell);
        uvec2 eight = texelFetch(densities, at(number), 0).xy;
        vec4 a = bytes(eight.x), b = bytes(eight.y);
        vec2 left = mix(vec2(a.x, a.z), vec2(a.y, a.w), f.x), right = mix(vec2(b.x, b.z), vec2(b.y, b.w), f.x);
        float raw = mix(mix(left.x, left.y, f.y), mix(right.x, right.y, f.y), f.z);
        float after = light * exp(-texelFetch(thickness, at(int(raw * float(FINER))), 0).x * length_);
        float weight = light - after;
        if (light > 0.5 && after <= 0.5) median = (s + (s1 - s) * (float(i) + (light - 0.5) / weight) / float(FINE)) * halfSize;
        if (weight > THRESHOLD) {
          colour(mean, slot, own, f, weight);
          total += weight;
        }
        light = after;
        if (light < STOP) break;
      }
      if (light < STOP) break;
    }
    known = true;
    p0 = p1;
    s = s1;
  }
  for (int i = 0; i < 4; i++) mean[i] = low[i] + scale[i] * mean[i] / max(total, 1e-6);
  first = uvec4(packHalf2x16(mean[0].xy), packHalf2x16(mean[0].zw), packHalf2x16(mean[1].xy), packHalf2x16(mean[1].zw));
  second = uvec4(packHalf2x16(mean[2].xy), packHalf2x16(mean[2].zw), packHalf2x16(mean[3].xy), packHalf2x16(mean[3].zw));
  float opacity = light < STOP ? 1.0 : 1.0 - light;
  rest = uvec2(floatBitsToUint(median * cosine), floatBitsToUint(total > 0.0 ? opacity : 0.0));
}
