/* The bootstrap filter of the quadratic model, written by hand for one processor's vectors.

   Its random numbers cost what JAX's do: Threefry-2x32 with 20 rounds, and normals from its bits by
   the polynomials of mpfjax/operations/random.py. */
#include <math.h>
#include <stdint.h>
#include <string.h>

#define LANES 16
#define VECTORS 4
#define BLOCK (LANES * VECTORS)

typedef float floats __attribute__((vector_size(4 * LANES)));
typedef int32_t whole __attribute__((vector_size(4 * LANES)));
typedef uint32_t words __attribute__((vector_size(4 * LANES)));

static float as_float(uint32_t bits) { float x; memcpy(&x, &bits, 4); return x; }

static inline words threefry(const uint32_t k[3], words counter) {
  static const int rotations[2][4] = {{13, 15, 26, 6}, {17, 29, 16, 24}};
  words high = counter * 0 + k[0], low = counter + k[1];
#pragma GCC unroll 5
  for (int group = 0; group < 5; group++) {
#pragma GCC unroll 4
    for (int round = 0; round < 4; round++) {
      const int by = rotations[group % 2][round];
      high += low;
      low = high ^ ((low << by) | (low >> (32 - by)));
    }
    high += k[(group + 1) % 3];
    low += k[(group + 2) % 3] + group + 1;
  }
  return high ^ low;
}

static inline floats uniforms(words bits) { return (floats)((bits >> 9) | 0x3F800000) - 1.0f; }

static inline floats logarithm(floats x) {
  static const float series[9] = {7.0376836292e-2f, -1.1514610310e-1f, 1.1676998740e-1f,
      -1.2420140846e-1f, 1.4249322787e-1f, -1.6668057665e-1f, 2.0000714765e-1f, -2.4999993993e-1f,
      3.3333331174e-1f};
  whole bits = (whole)x - 0x3F3504F3;
  floats f = (floats)((bits & 0x7FFFFF) + 0x3F3504F3) - 1.0f, sum = f * 0 + series[0];
#pragma GCC unroll 8
  for (int i = 1; i < 9; i++) sum = sum * f + series[i];
  return __builtin_convertvector(bits >> 23, floats) * 0.693147181f + (f + f * f * (f * sum - 0.5f));
}

static inline float exponential(float x) { /* Moshier's Cephes library, expf */
  x = x < -87.0f ? -87.0f : x;
  float power = floorf(x * 1.44269504f + 0.5f), r = x - power * 0.693359375f + power * 2.12194440e-4f;
  float sum = 1.9875691500e-4f;
  sum = sum * r + 1.3981999507e-3f;
  sum = sum * r + 8.3334519073e-3f;
  sum = sum * r + 4.1665795894e-2f;
  sum = sum * r + 1.6666665459e-1f;
  sum = sum * r + 5.0000001201e-1f;
  return (sum * r * r + r + 1.0f) * as_float((uint32_t)((int32_t)power + 127) << 23);
}

/* Giles (2010), table 5: the polynomial of the centre, and that of the tails. */
static const float centre[9] = {2.81022636e-08f, 3.43273939e-07f, -3.5233877e-06f, -4.39150654e-06f,
    0.00021858087f, -0.00125372503f, -0.00417768164f, 0.246640727f, 1.50140941f};
static const float tail[9] = {-0.000200214257f, 0.000100950558f, 0.00134934322f, -0.00367342844f,
    0.00573950773f, -0.0076224613f, 0.00943887047f, 1.00167406f, 2.83297682f};

/* BLOCK standard normal numbers. Few are in the tails, which take a root. */
static inline void normals(const uint32_t key[3], words counter, float draws[BLOCK]) {
  words bits[VECTORS];
  floats uniform[VECTORS], exponent[VECTORS];
  whole is_far = {0};
  for (int v = 0; v < VECTORS; v++) bits[v] = threefry(key, counter + v * LANES);
  for (int v = 0; v < VECTORS; v++) {
    floats x = uniforms(bits[v]) * 2.0f - 0.99999994f;
    uniform[v] = x;
    exponent[v] = -logarithm((1 - x) * (1 + x));
    is_far |= exponent[v] >= 5.0f;
    floats power = exponent[v] - 2.5f, sum = power * 0 + centre[0];
#pragma GCC unroll 8
    for (int i = 1; i < 9; i++) sum = sum * power + centre[i];
    sum *= 1.41421356f * x;
    memcpy(draws + v * LANES, &sum, sizeof sum);
  }
  uint64_t halves[LANES / 2], any = 0;
  memcpy(halves, &is_far, sizeof halves);
  for (int i = 0; i < LANES / 2; i++) any |= halves[i];
  if (__builtin_expect(any != 0, 0))
    for (int i = 0; i < BLOCK; i++) {
      float log_size = exponent[i / LANES][i % LANES];
      if (log_size < 5) continue;
      float power = sqrtf(log_size) - 3.0f, sum = tail[0];
      for (int j = 1; j < 9; j++) sum = sum * power + tail[j];
      draws[i] = 1.41421356f * sum * uniform[i / LANES][i % LANES];
    }
}

static inline whole larger(whole a, whole b) { return (a & (a > b)) | (b & ~(a > b)); }

/* Systematic resampling: each slot's parent. A parent is written to its first slot, where a later
   one with the same first slot replaces it; the running maximum fills the others. */
static void find_parents(const float *restrict weights, float total, float shift, int n,
                         int32_t *restrict parents) {
  static const whole before[4] = {
      {16, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14},
      {16, 16, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13},
      {16, 16, 16, 16, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11},
      {16, 16, 16, 16, 16, 16, 16, 16, 0, 1, 2, 3, 4, 5, 6, 7}};
  const floats nothing = {0};
  const whole none = {0};
  float upto = 0, slots = n / total;
  memset(parents, 0, 4 * n);
  for (int i = 0; i < n; i += LANES) { /* the arrays are filled up with weights of zero */
    floats sums;
    int32_t starts[LANES];
    memcpy(&sums, weights + i, sizeof sums);
    sums *= slots;
#pragma GCC unroll 4
    for (int k = 0; k < 4; k++) sums += __builtin_shuffle(sums, nothing, before[k]);
    floats starting = __builtin_shuffle(sums, nothing, before[0]) + upto;
    upto += sums[LANES - 1];
    starting -= shift;
    whole up = __builtin_convertvector(starting, whole);
    up -= __builtin_convertvector(up, floats) < starting; /* rounded up: true is -1 */
    memcpy(starts, &up, sizeof up);
    if (starts[LANES - 1] < n)
      for (int j = 0; j < LANES; j++) parents[starts[j]] = i + j;
    else
      for (int j = 0; j < LANES; j++)
        if (starts[j] < n && weights[i + j] > 0) parents[starts[j]] = i + j;
  }
  int32_t largest = 0;
  for (int i = 0; i < n; i += LANES) {
    whole last;
    memcpy(&last, parents + i, sizeof last);
#pragma GCC unroll 4
    for (int k = 0; k < 4; k++) {
      whole other = __builtin_shuffle(last, none, before[k]);
      last = larger(last, other);
    }
    last = larger(last, none + largest);
    memcpy(parents + i, &last, sizeof last);
    largest = last[LANES - 1];
  }
}

/* One run. `keys` has two words for each step, and two for x_0; `shifts` one number for each step.
   Every array of particles has room for n filled up to a multiple of BLOCK. Of each step come the
   mean, the effective sample size and the increment of the log-likelihood, 3 numbers. */
void run(const uint32_t *keys, const float *shifts, const float *observations, int num_steps, int n,
         float sigma_x, float sigma_y, float low, float high,
         float *restrict states, float *restrict moved, float *restrict log_weights,
         float *restrict weights, int32_t *restrict parents, float *restrict found) {
  const float log_scale = -logf(sigma_y) - 0.918938533f, precision = 1 / sigma_y;
  float total = 0;
  const uint32_t *first = keys + 2 * num_steps;
  const uint32_t start[3] = {first[0], first[1], first[0] ^ first[1] ^ 0x1BD11BDA};
  words lanes;
  for (int j = 0; j < LANES; j++) lanes[j] = j;
  for (int i = 0; i < n; i += LANES) {
    floats x = low + (high - low) * uniforms(threefry(start, lanes + i));
    memcpy(states + i, &x, sizeof x);
  }
  for (int t = 0; t < num_steps; t++, found += 3) {
    const uint32_t a = keys[2 * t], b = keys[2 * t + 1], key[3] = {a, b, a ^ b ^ 0x1BD11BDA};
    const float y = observations[t];
    if (t > 0) {
      find_parents(weights, total, shifts[t], n, parents);
      for (int i = 0; i < n; i++) moved[i] = states[parents[i]];
      memcpy(states, moved, 4 * n);
    }
    for (int i = 0; i < n; i += BLOCK) {
      float noise[BLOCK];
      normals(key, lanes + i, noise);
      for (int j = 0; j < BLOCK; j++) {
        float x = states[i + j] + sigma_x * noise[j], gap = (y - x * x) * precision;
        states[i + j] = x;
        log_weights[i + j] = log_scale - 0.5f * gap * gap;
      }
    }
    float largest = -3e38f, squares = 0, mean = 0;
    total = 0;
    for (int i = 0; i < n; i++) largest = log_weights[i] > largest ? log_weights[i] : largest;
    for (int i = 0; i < n; i++) {
      float gap = log_weights[i] - largest, weight = gap < -71.0f ? 0 : exponential(gap);
      weights[i] = weight;
      total += weight;
      squares += weight * weight;
      mean += weight * states[i];
    }
    found[0] = mean / total, found[1] = total * total / squares;
    found[2] = largest + logf(total / n);
  }
}
