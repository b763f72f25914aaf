/* Several numbers at once: what every node of the horizon needs alike is computed for LANES nodes together.
 *
 * `vec` is a vector of the compiler where it has them (GCC, Clang), else one double: the rest of the code is
 * written once. Memory of a `vec` is to be aligned to its size. The functions are free of branches, accurate to
 * a few units in the last place, and quiet about NaN, which they hand on.
 */
#ifndef LANES_H
#define LANES_H

#include <math.h>
#include <string.h>

#if defined(__GNUC__)
#ifndef LANES
#if defined(__AVX512F__)
#define LANES 8
#elif defined(__AVX__)
#define LANES 4
#else
#define LANES 2
#endif
#endif
typedef double vec __attribute__((vector_size(8 * LANES)));
typedef long long ivec __attribute__((vector_size(8 * LANES)));
#define LANE(v, l) ((v)[l])
#define MASK(condition) (condition)
#else
#undef LANES
#define LANES 1
typedef double vec;
typedef long long ivec;
#define LANE(v, l) (*(&(v) + (l)))
#define MASK(condition) (-(long long)(condition))
#endif

static inline ivec bits(vec v) {
    ivec i;
    memcpy(&i, &v, sizeof i);
    return i;
}

static inline vec number(ivec i) {
    vec v;
    memcpy(&v, &i, sizeof v);
    return v;
}

static inline vec all(double value) { return (vec){0} + value; }

/* a where the mask is set, else b. */
static inline vec choose(ivec mask, vec a, vec b) { return number((bits(a) & mask) | (bits(b) & ~mask)); }

static inline vec size_of(vec x) { return number(bits(x) & 0x7fffffffffffffffLL); }

/* 1.5 · 2^52: added to a number, it leaves the nearest integer in the low bits. */
#define ROUNDER 6755399441055744.0

/* exp(y) − 1 = 2^k (exp r − 1) + (2^k − 1) with |r| ≤ ln 2 / 2, for |y| ≤ 700. */
static inline vec expm1_of(vec y) {
    vec shifted = y * 1.4426950408889634074 + ROUNDER;
    vec k = shifted - ROUNDER;
    vec r = y - k * 6.93147180369123816490e-01 - k * 1.90821492927058770002e-10;
    /* Σ r^k / k!, k = 2 … 13, over r², by halves: a third of the delay of Horner's rule. */
    vec r2 = r * r, r4 = r2 * r2;
    vec a = (0.5 + r * (1.0 / 6.0)) + r2 * (1.0 / 24.0 + r * (1.0 / 120.0));
    vec b = (1.0 / 720.0 + r * (1.0 / 5040.0)) + r2 * (1.0 / 40320.0 + r * (1.0 / 362880.0));
    vec c = (1.0 / 3628800.0 + r * (1.0 / 39916800.0)) + r2 * (1.0 / 479001600.0 + r * (1.0 / 6227020800.0));
    vec p = (a + r4 * (b + r4 * c)) * r2 + r;
    vec power = number((bits(shifted) << 52) + (1023LL << 52));
    return power * p + (power - 1.0);
}

static inline vec tanh_of(vec x) {
    vec y = 2.0 * x;
    y = choose(MASK(y > 40.0), all(40.0), y);
    y = choose(MASK(y < -40.0), all(-40.0), y);
    vec e = expm1_of(y);
    return e / (e + 2.0);
}

/* exp(−x²/2) */
static inline vec bell_of(vec x) {
    vec y = -0.5 * x * x;
    return 1.0 + expm1_of(choose(MASK(y < -700.0), all(-700.0), y));
}

/* Angles above this are left to the C library: the reduction below loses digits there. */
#define FAR_ANGLE 1e5

/* sin and cos of an angle, reduced by multiples of π/2 in three parts. */
static inline void sincos_of(vec x, vec *sine, vec *cosine) {
    for (int l = 0; l < LANES; ++l) {
        if (!(fabs(LANE(x, l)) < FAR_ANGLE)) {
            vec s = x, c = x;
            for (int i = 0; i < LANES; ++i) LANE(s, i) = sin(LANE(x, i)), LANE(c, i) = cos(LANE(x, i));
            *sine = s, *cosine = c;
            return;
        }
    }
    vec shifted = x * 6.36619772367581382433e-01 + ROUNDER;
    vec k = shifted - ROUNDER;
    ivec quadrant = bits(shifted);
    vec r = x - k * 1.57079632673412561417e+00 - k * 6.07710050630396597660e-11 - k * 2.02226624879595063154e-21;
    vec q = r * r;
    vec s = all(-1.0 / 1307674368000.0);
    s = s * q + 1.0 / 6227020800.0;
    s = s * q - 1.0 / 39916800.0;
    s = s * q + 1.0 / 362880.0;
    s = s * q - 1.0 / 5040.0;
    s = s * q + 1.0 / 120.0;
    s = s * q - 1.0 / 6.0;
    s = s * q * r + r;
    vec c = all(1.0 / 20922789888000.0);
    c = c * q - 1.0 / 87178291200.0;
    c = c * q + 1.0 / 479001600.0;
    c = c * q - 1.0 / 3628800.0;
    c = c * q + 1.0 / 40320.0;
    c = c * q - 1.0 / 720.0;
    c = c * q + 1.0 / 24.0;
    c = c * q - 0.5;
    c = c * q + 1.0;
    ivec odd = MASK((quadrant & 1) != 0);
    *sine = number(bits(choose(odd, c, s)) ^ ((quadrant & 2) << 62));
    *cosine = number(bits(choose(odd, s, c)) ^ (((quadrant + 1) & 2) << 62));
}

#endif
