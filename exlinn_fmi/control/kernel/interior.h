/* The quadratic program by a primal-dual interior-point method on top of the Riccati recursion.
 *
 * Mehrotra's predictor and corrector (J. Nocedal, S. Wright, Numerical Optimization, 2nd ed., §16.6). It needs no
 * start and does not go round in circles: what the active set cannot settle is solved here, and handed back as soon as
 * its sets can be told.
 *
 * Rows a·y ≤ bound at each stage: inputs low, high; rates low, high; softened states low, high. A softened row is
 * a·y − σ ≤ bound with σ ≥ 0 at the price l1 σ + ½ l2 σ²; its slack and multiplier are eliminated.
 */
#ifndef INTERIOR_H
#define INTERIOR_H

#include "active.h"

#define INTERIOR_ROUNDS 80
#define TELLING 1e-3 /* mean product of gaps and multipliers, over the cost, from which on sets are tried */
#define TRIES 3

typedef struct {
    int soft;      /* index of the softened bound, −1: none */
    double sign;   /* of a */
    double value;  /* a·y */
    double bound;  /* ∞: there is no such row */
    double *weight, *slope;
} row;

static inline row row_at(const stages *v, int k, int i) {
    const int m = v->m, s = v->s;
    row r = {-1, i < 4 * m ? (i / m % 2 ? 1.0 : -1.0) : (i - 4 * m < s ? -1.0 : 1.0), 0.0, INFINITY, 0, 0};
    if (i < 2 * m) {
        int at = k * m + i % m;
        r.value = r.sign * v->du[at];
        r.bound = i < m ? -v->u_low[at] : v->u_high[at];
        r.weight = v->uw + at, r.slope = v->uq + at;
    } else if (i < 4 * m) {
        int at = k * m + i % m;
        if (!v->rated || k == 0) return r;
        r.value = r.sign * (v->du[at] - v->dz[k * v->z + v->n + i % m]);
        r.bound = i < 3 * m ? -v->rate_low[at] : v->rate_high[at];
        r.weight = v->rw + at, r.slope = v->rq + at;
    } else {
        int b = (i - 4 * m) % s, at = k * s + b;
        r.soft = b;
        r.value = r.sign * v->dz[(k + 1) * v->z + v->soft[b]];
        r.bound = r.sign < 0.0 ? -v->low[at] : v->high[at];
        r.weight = v->sw + at, r.slope = v->sq + at;
    }
    return r;
}

/* Weights and slopes of the barrier at the present point; `corrected`: with the predictor's second order. */
static void barrier(const stages *v, double centre, int corrected) {
    const int rows = 4 * v->m + 2 * v->s, m = v->m, s = v->s;
    for (int i = 0; i < v->N * m; ++i) v->uw[i] = v->uq[i] = v->rw[i] = v->rq[i] = 0.0;
    for (int i = 0; i < v->N * s; ++i) v->sw[i] = v->sq[i] = 0.0;
    for (int k = 0; k < v->N; ++k)
        for (int i = 0; i < rows; ++i) {
            row r = row_at(v, k, i);
            if (!(r.bound < INFINITY)) continue;
            int at = k * rows + i;
            double t = v->gap[at], w = v->lam[at] / t, share = 1.0;
            double to = (centre - (corrected ? v->dgap[at] * v->dlam[at] : 0.0)) / t;
            double q = to - w * (r.bound - t);
            if (r.soft >= 0) {
                double sigma = v->slack[at], D = v->l2[r.soft] + v->pi[at] / sigma;
                double e = (centre - (corrected ? v->dslack[at] * v->dpi[at] : 0.0)) / sigma;
                e -= v->l1[r.soft] + v->l2[r.soft] * sigma;
                share = D / (D + w);
                q -= w * (sigma + e / D);
            }
            *r.weight += share * w;
            *r.slope += r.sign * share * q;
        }
}

/* Directions of gaps and multipliers to the point that the recursion found, from the one in z_old and u_old. */
static double directions(stages *v, double centre, int corrected, double *affine) {
    const int rows = 4 * v->m + 2 * v->s;
    double length = 1.0, product = 0.0;
    stages old = *v;
    old.dz = v->z_old, old.du = v->u_old;
    for (int k = 0; k < v->N; ++k)
        for (int i = 0; i < rows; ++i) {
            row now = row_at(v, k, i), was = row_at(&old, k, i);
            if (!(now.bound < INFINITY)) continue;
            int at = k * rows + i;
            double t = v->gap[at], lam = v->lam[at], w = lam / t, moved = now.value - was.value;
            double to = (centre - (corrected ? v->dgap[at] * v->dlam[at] : 0.0)) / t;
            double off = now.bound - was.value - t;
            if (now.soft < 0) {
                v->dgap[at] = off - moved;
                v->dlam[at] = to - lam - w * v->dgap[at];
            } else {
                double sigma = v->slack[at], pi = v->pi[at], D = v->l2[now.soft] + pi / sigma;
                double back = (centre - (corrected ? v->dslack[at] * v->dpi[at] : 0.0)) / sigma;
                double e = back - v->l1[now.soft] - v->l2[now.soft] * sigma;
                off += sigma;
                double next = (to - w * off + w * moved - w * e / D) / (1.0 + w / D);
                v->dslack[at] = (next + e) / D;
                v->dgap[at] = off - moved + v->dslack[at];
                v->dlam[at] = next - lam;
                v->dpi[at] = back - pi / sigma * v->dslack[at] - pi;
                if (v->dslack[at] < 0.0) length = smaller(length, -sigma / v->dslack[at]);
                if (v->dpi[at] < 0.0) length = smaller(length, -pi / v->dpi[at]);
            }
            if (v->dgap[at] < 0.0) length = smaller(length, -t / v->dgap[at]);
            if (v->dlam[at] < 0.0) length = smaller(length, -lam / v->dlam[at]);
        }
    for (int k = 0; k < v->N; ++k)
        for (int i = 0; i < rows; ++i) {
            int at = k * rows + i;
            if (!(row_at(v, k, i).bound < INFINITY)) continue;
            product += (v->gap[at] + length * v->dgap[at]) * (v->lam[at] + length * v->dlam[at]);
            if (i >= 4 * v->m)
                product += (v->slack[at] + length * v->dslack[at]) * (v->pi[at] + length * v->dpi[at]);
        }
    *affine = product;
    return length;
}

/* A start well inside: no step, clipped, with gaps and multipliers of the program's size; returns how many.
 *
 * It need not obey the dynamics: the first full step does.
 */
static int interior_start(stages *v) {
    const int rows = 4 * v->m + 2 * v->s, us = v->N * v->m;
    for (int i = 0; i < us; ++i) v->du[i] = larger(smaller(0.0, v->u_high[i]), v->u_low[i]);
    memset(v->dz + v->z, 0, sizeof(double) * (size_t)(v->N * v->z));
    double price = larger(largest(v->r, us), largest(v->g, (v->N + 1) * v->z)), room = 1.0;
    /* Far inside: from near the bounds the first steps would be short. */
    price = 30.0 * larger(price, 1e-2 * largest(v->H_u, v->m * v->m));
    for (int k = 0; k < v->N; ++k)
        for (int i = 0; i < rows; ++i) {
            row r = row_at(v, k, i);
            if (r.bound < INFINITY) room = larger(room, smaller(fabs(r.bound - r.value), 1e3));
        }
    int count = 0;
    for (int k = 0; k < v->N; ++k)
        for (int i = 0; i < rows; ++i) {
            row r = row_at(v, k, i);
            int at = k * rows + i;
            v->gap[at] = v->lam[at] = v->slack[at] = v->pi[at] = 0.0;
            if (!(r.bound < INFINITY)) continue;
            double free = r.bound - r.value;
            if (r.soft >= 0) {
                v->slack[at] = larger(room, room - free);
                v->gap[at] = larger(free + v->slack[at], room);
                double whole = v->l1[r.soft] + v->l2[r.soft] * v->slack[at];
                v->lam[at] = smaller(price * room / v->gap[at], 0.5 * whole);
                v->pi[at] = whole - v->lam[at];
                count += 2;
            } else {
                v->gap[at] = larger(free, room);
                v->lam[at] = price * room / v->gap[at];
                ++count;
            }
        }
    return count;
}

/* The terms of the cost, all added up. */
static double cost_size(const stages *v) {
    const int z = v->z, m = v->m;
    double sum = 0.0;
    for (int k = 0; k <= v->N; ++k) {
        const double *H = k < v->N ? v->H : v->H_end, *dz = v->dz + k * z;
        for (int i = 0; i < z; ++i)
            sum += fabs(v->g[k * z + i] * dz[i]) + 0.5 * H[i * (z + 1)] * dz[i] * dz[i];
    }
    for (int i = 0; i < v->N * m; ++i)
        sum += fabs(v->r[i] * v->du[i]) + 0.5 * v->H_u[i % m * (m + 1)] * v->du[i] * v->du[i];
    return sum;
}

/* Which of two rows is active, by its multiplier over `price` against its gap. */
static inline long long active_row(const stages *v, int low, int high, double price) {
    if (v->lam[low] > 0.0 && v->lam[low] > price * v->gap[low]) return AT_LOW;
    return v->lam[high] > 0.0 && v->lam[high] > price * v->gap[high] ? AT_HIGH : FREE;
}

/* The sets that the interior point found. */
static void read_sets(stages *v) {
    const int m = v->m, s = v->s, rows = 4 * m + 2 * s;
    const double price = largest(v->lam, v->N * rows);
    for (int k = 0; k < v->N; ++k) {
        const int first = k * rows;
        for (int i = 0; i < m; ++i) {
            v->on[k * m + i] = active_row(v, first + i, first + m + i, price);
            v->slew[k * m + i] = active_row(v, first + 2 * m + i, first + 3 * m + i, price);
        }
        for (int b = 0; b < s; ++b) {
            const double l1 = v->l1[b] + 1e-300;
            int at = first + 4 * m + b;
            long long found = active_row(v, at, at + s, l1);
            if (found == AT_HIGH) at += s;
            if (found != FREE && v->slack[at] * l1 > v->pi[at]) found += BELOW - AT_LOW;
            v->state[k * s + b] = found;
        }
    }
}

/* Settle the sets that the interior point tells of by the active set; 0: it cannot, and the point is as it was. */
static int settle(stages *v, double loose) {
    const size_t zs = sizeof(double) * (size_t)((v->N + 1) * v->z), us = sizeof(double) * (size_t)(v->N * v->m);
    memcpy(v->z_old, v->dz, zs);
    memcpy(v->u_old, v->du, us);
    read_sets(v);
    set_all(v);
    v->interior = 0, v->loose = loose;
    if (solve_active(v, v->N, 10)) return 1;
    memcpy(v->dz, v->z_old, zs);
    memcpy(v->du, v->u_old, us);
    memset(v->on, 0, us);
    v->interior = 1;
    return 0;
}

/* Solve without regard to the sets, which are left as found here; 0 where it does not converge. */
static int solve_interior(stages *v) {
    const int rows = v->N * (4 * v->m + 2 * v->s), zs = (v->N + 1) * v->z, us = v->N * v->m;
    double product;
    int solved = 0, tries = TRIES;
    memset(v->on, 0, sizeof(long long) * (size_t)us);
    v->interior = 1;
    const int count = interior_start(v);
    double left = 1.0; /* of the first residuals */
    for (int round = 0; count && round < INTERIOR_ROUNDS && !solved; ++round) {
        ++v->iterations;
        memcpy(v->z_old, v->dz, sizeof(double) * (size_t)zs);
        memcpy(v->u_old, v->du, sizeof(double) * (size_t)us);
        double mean = 0.0;
        for (int at = 0; at < rows; ++at) mean += v->gap[at] * v->lam[at] + v->slack[at] * v->pi[at];
        mean /= count;
        if (!isfinite(mean)) break;
        barrier(v, 0.0, 0);
        if (!factor(v, v->N)) break;
        roll(v);
        directions(v, 0.0, 0, &product);
        double ratio = larger(product, 0.0) / count / mean, centre = ratio * ratio * ratio * mean;
        memcpy(v->dz, v->z_old, sizeof(double) * (size_t)zs);
        memcpy(v->du, v->u_old, sizeof(double) * (size_t)us);
        barrier(v, centre, 1);
        vectors(v);
        roll(v);
        double length = directions(v, centre, 1, &product);
        length = smaller(1.0, 0.995 * length);
        for (int i = 0; i < zs; ++i) v->dz[i] = v->z_old[i] + length * (v->dz[i] - v->z_old[i]);
        for (int i = 0; i < us; ++i) v->du[i] = v->u_old[i] + length * (v->du[i] - v->u_old[i]);
        for (int at = 0; at < rows; ++at) {
            if (!(v->gap[at] > 0.0)) continue;
            v->gap[at] += length * v->dgap[at];
            v->lam[at] += length * v->dlam[at];
            if (!(v->slack[at] > 0.0)) continue;
            v->slack[at] += length * v->dslack[at];
            v->pi[at] += length * v->dpi[at];
        }
        left *= 1.0 - length;
        const double cost = cost_size(v) / count;
        if (left < 1e-6 && mean < TELLING * cost && tries-- > 0 && settle(v, 1.0)) return 1;
        /* Where rounding stops it just before, the active set is told apart all the same. */
        solved = left < 1e-9 && (mean < 1e-11 * cost || (mean < 1e-7 * cost && length < 0.1));
    }
    if (solved && settle(v, 1e3)) return 1; /* a close decision at the solution is of no account */
    v->interior = 0;
    return solved;
}

/* Solve: by the active set from the sets in force, else by interior point, exact again by the active set.
 *
 * The recursion is up to date above node `from`. Returns 0: no solution, 1: active set, 2: interior point.
 */
static int solve_stages(stages *v, int from) {
    v->iterations = 0, v->loose = 1.0;
    if (solve_active(v, from, 25)) return 1;
    return solve_interior(v) ? 2 : 0;
}

#endif
