/* The quadratic program of one Gauss-Newton step, stage by stage, and its Riccati recursion.
 *
 *   minimise   Σ ½ dzᵀ H dz + gᵀ dz + ½ duᵀ Hu du + rᵀ du + softened bounds of the states at nodes 1 … N
 *   subject to dz⁺ = A dz + B du + c, dz_0 given, du within bounds, and du − (du of the stage before) within bounds.
 *
 * With bounds on the rate (`rated`) the state z is the model's n states and the last m inputs, else the n states.
 *
 * The recursion serves the active-set and the interior-point method alike: an input may be fixed (`on`), and each
 * bound may add ½ w y² + q y of what it bounds.
 */
#ifndef STAGES_H
#define STAGES_H

#include "dense.h"

#if defined(__GNUC__) /* so that loops of known length are unrolled */
#define FAST static inline __attribute__((always_inline))
#else
#define FAST static inline
#endif

#define MOST_INPUTS 16
#define MOST_STATES 80 /* with the last inputs */

/* What an input, its rate or a state does at its bounds; only a state may be beyond. */
enum { FREE, AT_LOW, AT_HIGH, BELOW, ABOVE };

/* Arrays of the program and its recursion, with their sizes. */
#define STAGE_ARRAYS(X)                                                                                              \
    X(A, N * z * z) X(B, N * z * m) X(c, N * z)                                                                      \
    X(H, z * z) X(H_end, z * z) X(H_u, m * m) X(g, (N + 1) * z) X(r, N * m)                                          \
    X(u_low, N * m) X(u_high, N * m) X(rate_low, N * m) X(rate_high, N * m)                                          \
    X(low, N * s) X(high, N * s) X(l1, s) X(l2, s)                                                                   \
    X(dz, (N + 1) * z) X(du, N * m)                                                                                  \
    X(P, (N + 1) * z * z) X(p, (N + 1) * z) X(K, N * m * z) X(k, N * m)                                              \
    X(Huu, N * m * m) X(Hux, m * z) X(L, N * m * m) X(G, N * m * z) X(pull, N * m)                               \
    X(fixed, N * m) X(uw, N * m) X(uq, N * m) X(rw, N * m) X(rq, N * m) X(sw, N * s) X(sq, N * s)                    \
    X(pushed, N * s) X(stiff, s) X(tugged, N * m) X(taut, m) X(PA, z * z) X(PB, z * m) X(closed, z * z)

#define INTERIOR_ARRAYS(X)                                                                                           \
    X(gap, rows) X(lam, rows) X(slack, rows) X(pi, rows) X(dgap, rows) X(dlam, rows) X(dslack, rows) X(dpi, rows)    \
    X(z_old, (N + 1) * z) X(u_old, N * m)

typedef struct {
    int N, n, m, z, s, rated;
    const long long *soft; /* (s) states that are bounded */
    long long *on;         /* (N, m) what each input does */
    long long *slew;       /* (N, m) what its rate does */
    long long *state;      /* (N, s) what each softened state does, at nodes 1 … N */
    int interior;          /* whether bounds act through weights alone */
    double loose;          /* factor of the tolerances by which sets are told */
    long long iterations;
#define X(name, size) double *name;
    STAGE_ARRAYS(X) INTERIOR_ARRAYS(X)
#undef X
} stages;

/* Weights (on the diagonal of P) and slopes (on p) that the softened bounds put on node j = 1 … N; 0: not wanted. */
static inline void soften(const stages *v, int j, double *P, double *p) {
    for (int b = 0; b < v->s; ++b) {
        int i = (int)v->soft[b], at = (j - 1) * v->s + b;
        if (!v->interior && v->state[at] == FREE) continue;
        if (P) P[i * v->z + i] += v->sw[at];
        if (p) p[i] += v->sq[at];
    }
}

/* Vectors of the recursion at stage k: p, k and the pull on fixed inputs, from p of the next node. */
FAST void stage_vectors(const stages *v, const int k, const int z, const int m) {
    const double *A = v->A + k * z * z, *B = v->B + k * z * m, *c = v->c + k * z, *K = v->K + k * m * z;
    const double *P1 = v->P + (k + 1) * z * z, *p1 = v->p + (k + 1) * z, *Huu = v->Huu + k * m * m;
    const long long *on = v->on + k * m;
    double *gain = v->k + k * m, *pull = v->pull + k * m, *p = v->p + k * z;
    double next[MOST_STATES], costate[MOST_STATES], h[MOST_INPUTS], b[MOST_INPUTS];
    int free[MOST_INPUTS], count = 0;
    for (int i = 0; i < z; ++i) {
        double sum = p1[i];
        for (int j = 0; j < z; ++j) sum += P1[i * z + j] * c[j];
        costate[i] = sum;
    }
    for (int i = 0; i < m; ++i) {
        double sum = v->r[k * m + i];
        for (int j = 0; j < z; ++j) sum += B[j * m + i] * costate[j];
        h[i] = sum;
        if (v->interior) h[i] += v->uq[k * m + i];
        if (v->rated) h[i] += v->rq[k * m + i];
        if (on[i] == FREE) free[count++] = i;
        gain[i] = on[i] == FREE ? 0.0 : v->fixed[k * m + i];
    }
    for (int f = 0; f < count; ++f) {
        b[f] = h[free[f]];
        for (int i = 0; i < m; ++i) b[f] += Huu[free[f] * m + i] * gain[i];
    }
    cholesky_solve(count, v->L + k * m * m, b);
    for (int f = 0; f < count; ++f) gain[free[f]] = -b[f];

    for (int i = 0; i < z; ++i) {
        next[i] = 0.0;
        for (int j = 0; j < m; ++j) next[i] += B[i * m + j] * gain[j];
    }
    for (int i = 0; i < z; ++i)
        for (int j = 0; j < z; ++j) costate[i] += P1[i * z + j] * next[j];
    for (int i = 0; i < z; ++i) {
        double sum = v->g[k * z + i];
        for (int j = 0; j < z; ++j) sum += A[j * z + i] * costate[j];
        p[i] = sum;
    }
    for (int i = 0; i < m; ++i) {
        double sum = v->r[k * m + i];
        for (int j = 0; j < z; ++j) sum += B[j * m + i] * costate[j];
        for (int j = 0; j < m; ++j) sum += v->H_u[i * m + j] * gain[j];
        if (v->rated) {
            double rate = v->rw[k * m + i] * gain[i] + v->rq[k * m + i];
            sum += rate;
            p[v->n + i] -= rate;
        }
        pull[i] = sum;
        if (v->interior) sum += v->uw[k * m + i] * gain[i] + v->uq[k * m + i];
        for (int j = 0; j < z; ++j) p[j] += K[i * z + j] * sum;
    }
    if (k > 0) soften(v, k, 0, p);
}

/* The whole recursion at stage k, from P and p of the next node; 0 where the Hessian is not positive definite.
 *
 * P is a sum of squares of the closed loop (Joseph's form): however stiff a bound is, what is computed stays exact.
 */
FAST int stage_factor(const stages *v, const int k, const int z, const int m) {
    const double *A = v->A + k * z * z, *B = v->B + k * z * m, *P1 = v->P + (k + 1) * z * z;
    double *PA = v->PA, *PB = v->PB, *closed = v->closed, *Huu = v->Huu + k * m * m, *Hux = v->Hux;
    double *K = v->K + k * m * z, *G = v->G + k * m * z, *L = v->L + k * m * m, *P = v->P + k * z * z;
    const long long *on = v->on + k * m;
    int free[MOST_INPUTS], count = 0;
    multiply(z, z, z, P1, A, PA);
    multiply(z, z, m, P1, B, PB);
    for (int i = 0; i < m; ++i) {
        for (int j = 0; j < m; ++j) {
            double sum = v->H_u[i * m + j];
            for (int l = 0; l < z; ++l) sum += B[l * m + i] * PB[l * m + j];
            Huu[i * m + j] = sum;
        }
        for (int j = 0; j < z; ++j) {
            double sum = 0.0;
            for (int l = 0; l < z; ++l) sum += B[l * m + i] * PA[l * z + j];
            Hux[i * z + j] = sum;
        }
        if (v->interior) Huu[i * m + i] += v->uw[k * m + i];
        if (v->rated) Huu[i * m + i] += v->rw[k * m + i], Hux[i * z + v->n + i] -= v->rw[k * m + i];
        if (on[i] == FREE)
            free[count++] = i;
        else
            for (int j = 0; j < z; ++j) K[i * z + j] = 0.0;
    }
    for (int a = 0; a < count; ++a)
        for (int b = 0; b < count; ++b) L[a * count + b] = Huu[free[a] * m + free[b]];
    if (!cholesky(count, L)) return 0;
    for (int j = 0; j < z; ++j) {
        double b[MOST_INPUTS];
        for (int f = 0; f < count; ++f) b[f] = Hux[free[f] * z + j];
        cholesky_solve(count, L, b);
        for (int f = 0; f < count; ++f) K[free[f] * z + j] = -b[f];
    }
    for (int i = 0; i < m; ++i)
        for (int j = 0; j < z && on[i] != FREE; ++j) {
            double sum = Hux[i * z + j];
            for (int l = 0; l < m; ++l) sum += Huu[i * m + l] * K[l * z + j];
            G[i * z + j] = sum;
        }
    for (int i = 0; i < z; ++i)
        for (int j = 0; j < z; ++j) {
            double sum = A[i * z + j], product = PA[i * z + j];
            for (int l = 0; l < m; ++l) {
                sum += B[i * m + l] * K[l * z + j];
                product += PB[i * m + l] * K[l * z + j];
            }
            closed[i * z + j] = sum;
            PA[i * z + j] = product;
        }
    for (int i = 0; i < z; ++i)
        for (int j = i; j < z; ++j) {
            double sum = v->H[i * z + j];
            for (int l = 0; l < z; ++l) sum += closed[l * z + i] * PA[l * z + j];
            for (int a = 0; a < m; ++a)
                for (int b = 0; b < m; ++b) sum += K[a * z + i] * v->H_u[a * m + b] * K[b * z + j];
            P[i * z + j] = sum;
        }
    for (int a = 0; a < m && (v->interior || v->rated); ++a) {
        double uw = v->interior ? v->uw[k * m + a] : 0.0, rw = v->rated ? v->rw[k * m + a] : 0.0;
        const int last = v->rated ? v->n + a : z;
        for (int i = 0; i < z; ++i)
            for (int j = i; j < z; ++j) {
                double x = K[a * z + i], y = K[a * z + j];
                P[i * z + j] += uw * x * y + rw * (x - (i == last)) * (y - (j == last));
            }
    }
    for (int i = 0; i < z; ++i)
        for (int j = 0; j < i; ++j) P[i * z + j] = P[j * z + i];
    if (k > 0) soften(v, k, P, 0);
    stage_vectors(v, k, z, m);
    return 1;
}

/* The recursion's end at node N. */
static void last_node(const stages *v) {
    const int z = v->z, N = v->N;
    memcpy(v->P + N * z * z, v->H_end, sizeof(double) * (size_t)(z * z));
    memcpy(v->p + N * z, v->g + N * z, sizeof(double) * (size_t)z);
    soften(v, N, v->P + N * z * z, v->p + N * z);
}

/* The recursion from node `from` on down; 0 where a Hessian is not positive definite. */
static int factor(const stages *v, int from) {
    if (from >= v->N) last_node(v);
    for (int k = from < v->N ? from : v->N - 1; k >= 0; --k) {
        int done = v->z == 3 && v->m == 1   ? stage_factor(v, k, 3, 1)
                   : v->z == 4 && v->m == 2 ? stage_factor(v, k, 4, 2)
                                            : stage_factor(v, k, v->z, v->m);
        if (!done) return 0;
    }
    return 1;
}

/* The vectors of the recursion alone, where no weight and no fixed input has changed. */
static void vectors(const stages *v) {
    const int z = v->z, N = v->N;
    memcpy(v->p + N * z, v->g + N * z, sizeof(double) * (size_t)z);
    soften(v, N, 0, v->p + N * z);
    for (int k = N - 1; k >= 0; --k) stage_vectors(v, k, z, v->m);
}

/* dz and du from dz_0 and the gains. */
FAST void roll_stages(const stages *v, const int z, const int m) {
    for (int k = 0; k < v->N; ++k) {
        const double *K = v->K + k * m * z, *A = v->A + k * z * z, *B = v->B + k * z * m, *dz = v->dz + k * z;
        double *du = v->du + k * m, *next = v->dz + (k + 1) * z;
        for (int i = 0; i < m; ++i) {
            double sum = v->k[k * m + i];
            for (int j = 0; j < z; ++j) sum += K[i * z + j] * dz[j];
            du[i] = sum;
        }
        for (int i = 0; i < z; ++i) {
            double sum = v->c[k * z + i];
            for (int j = 0; j < z; ++j) sum += A[i * z + j] * dz[j];
            for (int j = 0; j < m; ++j) sum += B[i * m + j] * du[j];
            next[i] = sum;
        }
    }
}

static void roll(const stages *v) {
    if (v->z == 3 && v->m == 1)
        roll_stages(v, 3, 1);
    else
        roll_stages(v, v->z, v->m);
}

#endif
