// From a pixel's mean features to what is shown: `backends/numba/decode.py`, and what lies behind everything (`render/sky.py`).

uniform highp usampler2D first, second, rest;
uniform highp sampler2D palette;
uniform vec4 lens;
uniform mat3 turn;
uniform vec2 size, range;  // of inverse depth, from far to near
uniform vec3 sky[9];       // of one colour: the others are 0
uniform int show;          // 0 colours, 1 depth, 2 opacity
uniform float exposure;
uniform bool cropped;      // then nothing is behind it

const int INPUTS = 8, WIDE = HIDDEN / 4, THIRD = WIDE / 3;
layout(std140) uniform Small { mat4 w1[WIDE * INPUTS]; vec4 b1[WIDE], b2[WIDE], w3[3 * WIDE], b3; };
// A block holds 16 kB everywhere; the second layer takes more.
layout(std140) uniform Large0 { mat4 w2_0[THIRD * WIDE]; };
layout(std140) uniform Large1 { mat4 w2_1[THIRD * WIDE]; };
layout(std140) uniform Large2 { mat4 w2_2[THIRD * WIDE]; };

out vec4 shown;

void harmonics(vec3 d, out float h[16]) {
  float xx = d.x * d.x, yy = d.y * d.y, zz = 5.0 * d.z * d.z;
  h = float[16](C0, -C1 * d.y, C1 * d.z, -C1 * d.x, C2 * d.x * d.y, -C2 * d.y * d.z, C3 * (3.0 * d.z * d.z - 1.0), -C2 * d.x * d.z,
    C4 * (xx - yy), -C5 * d.y * (3.0 * xx - yy), C6 * d.x * d.y * d.z, -C7 * d.y * (zz - 1.0), C8 * d.z * (zz - 3.0),
    -C7 * d.x * (zz - 1.0), C9 * d.z * (xx - yy), -C5 * d.x * (xx - 3.0 * yy));
}

vec3 decoded(vec4 given[INPUTS]) {
  vec4 h[WIDE];
  for (int j = 0; j < WIDE; j++) {
    vec4 sum = b1[j];
    for (int i = 0; i < INPUTS; i++) sum += w1[j * INPUTS + i] * given[i];
    h[j] = max(sum, 0.0);
  }
  vec3 out_ = given[0].xyz + b3.xyz;
#define ADD(W2, FIRST) for (int j = 0; j < THIRD; j++) { \
    vec4 sum = b2[FIRST + j]; \
    for (int i = 0; i < WIDE; i++) sum += W2[j * WIDE + i] * h[i]; \
    sum = max(sum, 0.0); \
    out_ += vec3(dot(w3[FIRST + j], sum), dot(w3[WIDE + FIRST + j], sum), dot(w3[2 * WIDE + FIRST + j], sum)); \
  }
  ADD(w2_0, 0)
  ADD(w2_1, THIRD)
  ADD(w2_2, 2 * THIRD)
  return 1.0 / (1.0 + exp(-clamp(out_, -80.0, 80.0)));
}

// `brighter` of `tone.py`, on sRGB.
vec3 exposed(vec3 colour) {
  if (exposure == 1.0) return colour;
  vec3 light = exposure * mix(colour / 12.92, pow((colour + 0.055) / 1.055, vec3(2.4)), step(0.04045, colour));
  if (exposure > 1.0) {
    float steep = (exposure - SHOULDER) / (1.0 - SHOULDER);
    vec3 over = clamp((light - SHOULDER) / (exposure - SHOULDER), 0.0, 1.0);
    light = mix(light, SHOULDER + (1.0 - SHOULDER) * steep * over / (1.0 + (steep - 1.0) * over), step(SHOULDER, light));
  }
  return mix(12.92 * light, 1.055 * pow(max(light, 1e-9), vec3(1.0 / 2.4)) - 0.055, step(0.0031308, light));
}

void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  uvec4 told = texelFetch(rest, at, 0);
  float depth = uintBitsToFloat(told.x), opacity = uintBitsToFloat(told.y);
  if (show == 2) {
    shown = vec4(vec3(opacity), 1);
    return;
  }
  if (show == 1) {
    float part = clamp((1.0 / max(depth, 1e-6) - range.x) / (range.y - range.x), 0.0, 1.0);
    shown = opacity >= 0.5 && depth > 0.0 ? texture(palette, vec2(part * (255.0 / 256.0) + 0.5 / 256.0, 0.5)) : vec4(vec3(0.5), 1);
    return;
  }
  vec2 pixel = (vec2(gl_FragCoord.x, size.y - gl_FragCoord.y) - lens.zw) / lens.xy;
  vec3 d = turn * normalize(vec3(pixel, 1.0));
  float h[16];
  harmonics(d, h);
  vec3 behind = vec3(0);
  for (int i = 0; i < 9; i++) behind += sky[i] * h[i];
  behind = cropped ? vec3(0.1) : clamp(behind, 0.0, 1.0);
  if (opacity == 0.0) {
    shown = vec4(exposed(behind), 1);
    return;
  }
  uvec4 a = texelFetch(first, at, 0), b = texelFetch(second, at, 0);
  vec4 given[INPUTS] = vec4[INPUTS](
    vec4(unpackHalf2x16(a.x), unpackHalf2x16(a.y)), vec4(unpackHalf2x16(a.z), unpackHalf2x16(a.w)),
    vec4(unpackHalf2x16(b.x), unpackHalf2x16(b.y)), vec4(unpackHalf2x16(b.z), unpackHalf2x16(b.w)),
    vec4(h[0], h[1], h[2], h[3]), vec4(h[4], h[5], h[6], h[7]), vec4(h[8], h[9], h[10], h[11]), vec4(h[12], h[13], h[14], h[15]));
  shown = vec4(exposed(mix(behind, decoded(given), opacity)), 1);
}
