/* The structured learned model (mechanics/learned.py) at LANES points at once: accelerations and derivatives.
 *
 * Networks are evaluated as jets: value, first and second derivatives with respect to the positions, carried
 * through features, products and tanh units. Weights are data. Everything inside is dimensionless (`Scales`):
 * M(x) w' + c(x, w) = F with M = L Lᵀ + ε, and with μ_c = Σ_i L_ic w_i for each column c of L
 *
 *     c_i = Σ_c (L̇_ic μ_c + L_ic μ̇_c − μ_c ∂_iμ_c) + Σ_k (∂_k A_i − ∂_i A_k + G_ik) w_k + ∂_i V + ∂D/∂w_i.
 */
#ifndef NETWORK_H
#define NETWORK_H

#include "lanes.h"

#define MOST_COORDINATES 8
#define MOST_COLUMNS 24
#define MOST_JET 45 /* 1 + 8 + 8 · 9 / 2 */

/* Sizes at the head of the integers that describe a model; lists follow in the order of `network_open`. */
enum { COORDINATES, POSITIONS, FEATURES, PRODUCTS, HIDDEN, OUTPUTS, COLUMNS, FRICTION, BUMPS, DRIVES, DEPTH, HEAD };

typedef struct {
    int nq, np, nf, products, hidden, outputs, columns, friction, bumps, drives, depth, basis, jet;
    int begin[MOST_COORDINATES], end[MOST_COORDINATES]; /* columns of L in which a coordinate has a part */
    const long long *position;  /* (nq) index of a coordinate among the positions, −1: cyclic */
    const long long *owner;     /* (np) coordinate of each position */
    const long long *circle;    /* (np) 1: sin and cos are its features, 0: a line */
    const long long *factors;   /* (products, 3) features that are multiplied, −1: none */
    const long long *kind;      /* (outputs) 0: L, 1: A, 2: V */
    const long long *row;       /* (outputs) coordinate */
    const long long *column;    /* (outputs) column of L */
    const long long *drive;     /* (drives) coordinate that each input acts on */
    const double *length;       /* (nq) unit of each coordinate */
    const double *centre;       /* (np) of a line */
    const double *slope;        /* (np) feature's argument over coordinate: 1/reach or rad per unit of angle */
    const double *epsilon;      /* (nq) */
    const double *weight;       /* (hidden, nf), then (depth − 1, hidden, hidden) */
    const double *bias;         /* (depth, hidden) */
    const double *output;       /* (outputs, basis) */
    const double *gyro;         /* (nq, nq) G: antisymmetric part of the linear coupling */
    const double *offset;       /* (nq) constant forces */
    const double *viscous;      /* (nq) factor of w in ∂D/∂w */
    const double *quadratic;    /* (nq) of w |w| */
    const double *strength;     /* (nq, friction) of tanh(w/width), and of w/width exp(−(w/width)²/2) in the bumps */
    const double *sharpness;    /* (nq, friction) 1/width */
    double time, energy;
} network;

static network network_open(const long long *ints, const double *data) {
    network g;
    g.nq = (int)ints[COORDINATES], g.np = (int)ints[POSITIONS], g.nf = (int)ints[FEATURES];
    g.products = (int)ints[PRODUCTS], g.hidden = (int)ints[HIDDEN], g.outputs = (int)ints[OUTPUTS];
    g.columns = (int)ints[COLUMNS], g.friction = (int)ints[FRICTION];
    g.bumps = (int)ints[BUMPS], g.drives = (int)ints[DRIVES];
    g.depth = (int)ints[DEPTH];
    g.basis = 1 + g.nf + g.products + g.hidden;
    g.jet = 1 + g.np + g.np * (g.np + 1) / 2;
    g.position = ints + HEAD;
    g.owner = g.position + g.nq;
    g.circle = g.owner + g.np;
    g.factors = g.circle + g.np;
    g.kind = g.factors + 3 * g.products;
    g.row = g.kind + g.outputs;
    g.column = g.row + g.outputs;
    g.drive = g.column + g.outputs;
    for (int i = 0; i < g.nq; ++i) g.begin[i] = g.columns, g.end[i] = 0;
    for (int o = 0; o < g.outputs; ++o) {
        int i = (int)g.row[o], c = (int)g.column[o];
        if (g.kind[o] == 0 && c < g.begin[i]) g.begin[i] = c;
        if (g.kind[o] == 0 && c >= g.end[i]) g.end[i] = c + 1;
    }
    g.time = data[0], g.energy = data[1];
    g.length = data + 2;
    g.centre = g.length + g.nq;
    g.slope = g.centre + g.np;
    g.epsilon = g.slope + g.np;
    g.weight = g.epsilon + g.nq;
    g.bias = g.weight + g.hidden * (g.nf + (g.depth - 1) * g.hidden);
    g.output = g.bias + g.depth * g.hidden;
    g.gyro = g.output + g.outputs * g.basis;
    g.offset = g.gyro + g.nq * g.nq;
    g.viscous = g.offset + g.nq;
    g.quadratic = g.viscous + g.nq;
    g.strength = g.quadratic + g.nq;
    g.sharpness = g.strength + g.nq * g.friction;
    return g;
}

/* Numbers of type vec that an evaluation needs. */
static size_t network_scratch(const network *g) {
    return (size_t)((g->basis + g->hidden + g->nq * g->columns + g->nq + 1) * g->jet);
}

/* Place of the second derivative by positions k and l in a jet. */
static inline int pair(int np, int k, int l) {
    int a = k < l ? k : l, b = k < l ? l : k;
    return 1 + np + a * np - a * (a - 1) / 2 + b - a;
}

/* out = a b */
static void jet_product(int np, const vec *a, const vec *b, vec *out) {
    for (int k = 0, s = 1 + np; k < np; ++k)
        for (int l = k; l < np; ++l, ++s)
            out[s] = a[s] * b[0] + a[0] * b[s] + a[1 + k] * b[1 + l] + a[1 + l] * b[1 + k];
    for (int k = 1; k <= np; ++k) out[k] = a[k] * b[0] + a[0] * b[k];
    out[0] = a[0] * b[0];
}

/* out = f(a) from f, f', f'' at a's value. */
static inline void jet_chain(int np, const vec *a, vec f, vec slope, vec bend, vec *out) {
    for (int k = 0, s = 1 + np; k < np; ++k) {
        vec by = bend * a[1 + k];
        for (int l = k; l < np; ++l, ++s) out[s] = by * a[1 + l] + slope * a[s];
    }
    for (int k = 1; k <= np; ++k) out[k] = slope * a[k];
    out[0] = f;
}

/* out = Σ_i weight_i jets_i, three numbers of the jet at a time so that sums stay in registers. */
static void jet_sum(int D, int count, const double *weight, const vec *jets, vec *out) {
    int d = 0;
    for (; d + 3 <= D; d += 3) {
        vec a = all(0.0), b = a, c = a;
        const vec *at = jets + d;
        for (int i = 0; i < count; ++i, at += D) {
            a += weight[i] * at[0];
            b += weight[i] * at[1];
            c += weight[i] * at[2];
        }
        out[d] = a, out[d + 1] = b, out[d + 2] = c;
    }
    for (; d < D; ++d) {
        vec a = all(0.0);
        for (int i = 0; i < count; ++i) a += weight[i] * jets[D * i + d];
        out[d] = a;
    }
}

/* A layer of tanh units, from `count` jets to `units` of them. */
static void jet_layer(int np, int count, int units, const double *weight, const double *bias, const vec *in, vec *out) {
    const int D = 1 + np + np * (np + 1) / 2;
    vec a[MOST_JET];
    for (int j = 0; j < units; ++j) {
        jet_sum(D, count, weight + j * count, in, a);
        vec t = tanh_of(a[0] + bias[j]), slope = 1.0 - t * t;
        jet_chain(np, a, t, slope, -2.0 * t * slope, out + j * D);
    }
}

/* Jets of all functions in the basis [1, features, products, tanh units], shape (basis, jet). */
static void network_basis(const network *g, const vec *x, vec *T) {
    const int np = g->np, D = g->jet;
    vec *feature = T + D, a[MOST_JET];
    for (int d = 0; d < D; ++d) T[d] = all(d == 0);
    memset(feature, 0, sizeof(vec) * (size_t)(g->nf * D));
    for (int k = 0; k < np; ++k) {
        double slope = g->slope[k], by = slope * g->length[g->owner[k]];
        int first = 1 + k, second = pair(np, k, k);
        if (g->circle[k]) {
            vec s, c;
            sincos_of(slope * x[k], &s, &c);
            feature[0] = s, feature[first] = by * c, feature[second] = -by * by * s;
            feature += D;
            feature[0] = c, feature[first] = -by * s, feature[second] = -by * by * c;
        } else { /* kept up to ±2, led from there on towards ±3 */
            vec z = slope * (x[k] - g->centre[k]), beyond = size_of(z) - 2.0;
            beyond = choose(MASK(beyond < 0.0), all(0.0), beyond);
            ivec sign = bits(z) & (-0x7fffffffffffffffLL - 1);
            vec t = tanh_of(beyond), rest = 1.0 - t * t;
            feature[0] = z - number(bits(beyond - t) ^ sign);
            feature[first] = by * rest;
            feature[second] = -2.0 * by * by * number(bits(t) ^ sign) * rest;
        }
        feature += D;
    }
    for (int i = 0; i < g->products; ++i, feature += D) {
        const long long *f = g->factors + 3 * i;
        jet_product(np, T + D * (1 + f[0]), T + D * (1 + f[1]), f[2] < 0 ? feature : a);
        if (f[2] >= 0) jet_product(np, a, T + D * (1 + f[2]), feature);
    }
    /* Layers take turns, so that the last one ends up in the basis. */
    const double *weight = g->weight;
    const vec *in = T + D;
    for (int layer = 0, count = g->nf; layer < g->depth; ++layer, count = g->hidden) {
        vec *out = (g->depth - layer) % 2 ? feature : feature + g->hidden * D;
        jet_layer(np, count, g->hidden, weight, g->bias + layer * g->hidden, in, out);
        weight += g->hidden * count;
        in = out;
    }
}

/* L D Lᵀ of a symmetric positive definite matrix in place: L below the diagonal, 1/D on it. */
static void mass_factor(int n, vec *M) {
    for (int j = 0; j < n; ++j) {
        M[j * n + j] = 1.0 / M[j * n + j];
        for (int i = j + 1; i < n; ++i) {
            vec given = M[i * n + j], factor = given * M[j * n + j];
            for (int k = j + 1; k < i; ++k) M[i * n + k] -= given * M[k * n + j];
            M[i * n + i] -= given * factor;
            M[i * n + j] = factor;
        }
    }
}

static void mass_solve(int n, const vec *M, vec *b, int stride) {
    for (int i = 0; i < n; ++i)
        for (int k = 0; k < i; ++k) b[i * stride] -= M[i * n + k] * b[k * stride];
    for (int i = 0; i < n; ++i) b[i * stride] *= M[i * n + i];
    for (int i = n - 1; i >= 0; --i)
        for (int k = i + 1; k < n; ++k) b[i * stride] -= M[k * n + i] * b[k * stride];
}

/* Jets of L (nq, columns), A (nq) and V behind each other. */
static void network_functions(const network *g, const vec *q, vec *T, vec *functions) {
    network_basis(g, q, T);
    const int D = g->jet, C = g->columns;
    memset(functions, 0, sizeof(vec) * (size_t)((g->nq * C + g->nq + 1) * D));
    for (int o = 0; o < g->outputs; ++o) {
        int i = (int)g->row[o];
        int place = g->kind[o] == 0 ? i * C + (int)g->column[o] : g->nq * C + (g->kind[o] == 1 ? i : g->nq);
        jet_sum(D, g->basis, g->output + o * g->basis, T, functions + place * D);
    }
}

/* Add friction ∂D/∂w of velocity i to a force, and its slope to the force's slope. */
static inline void network_friction(const network *g, int i, vec w, vec *force, vec *slope) {
    const double *strength = g->strength + i * g->friction, *sharpness = g->sharpness + i * g->friction;
    vec f = *force + g->viscous[i] * w, by = *slope + g->viscous[i];
    for (int k = 0; k < g->friction - g->bumps; ++k) {
        vec t = tanh_of(sharpness[k] * w);
        f += strength[k] * t;
        by += strength[k] * sharpness[k] * (1.0 - t * t);
    }
    for (int k = g->friction - g->bumps; k < g->friction; ++k) {
        vec r = sharpness[k] * w, e = bell_of(r);
        f += strength[k] * r * e;
        by += strength[k] * sharpness[k] * (1.0 - r * r) * e;
    }
    *force = f + g->quadratic[i] * w * size_of(w);
    *slope = by + 2.0 * g->quadratic[i] * size_of(w);
}

/* The forces c(x, w), their derivatives by the n = np + nq states, and M(x): everything but F. */
static void network_forces(const network *g, const vec *w, const vec *functions, vec *M, vec *c, vec *cx) {
    const int nq = g->nq, np = g->np, n = np + nq, D = g->jet, C = g->columns;
    const vec *A = functions + nq * C * D, *V = A + nq * D;
    for (int i = 0; i < nq; ++i) {
        c[i] = all(-g->offset[i]);
        for (int l = 0; l < np; ++l) cx[i * n + l] = all(0.0);
        for (int j = 0; j < nq; ++j) {
            M[i * nq + j] = all(i == j ? g->epsilon[i] : 0.0);
            cx[i * n + np + j] = all(g->gyro[i * nq + j]);
            c[i] += g->gyro[i * nq + j] * w[j];
        }
        network_friction(g, i, w[i], c + i, cx + i * n + np + i);
    }
    for (int col = 0; col < C; ++col) {
        vec mu[MOST_JET], moving = all(0.0), moving_by[MOST_COORDINATES], dot[MOST_COORDINATES];
        for (int d = 0; d < D; ++d) mu[d] = all(0.0);
        for (int i = 0; i < nq; ++i) {
            if (col < g->begin[i] || col >= g->end[i]) continue;
            const vec *L = functions + (i * C + col) * D;
            for (int d = 0; d < D; ++d) mu[d] += w[i] * L[d];
            dot[i] = all(0.0);
            for (int k = 0; k < np; ++k) dot[i] += L[1 + k] * w[g->owner[k]];
        }
        for (int k = 0; k < np; ++k) {
            moving += mu[1 + k] * w[g->owner[k]];
            moving_by[k] = all(0.0);
            for (int l = 0; l < np; ++l) moving_by[k] += mu[pair(np, k, l)] * w[g->owner[l]];
        }
        for (int i = 0; i < nq; ++i) {
            int at = (int)g->position[i];
            int inside = col >= g->begin[i] && col < g->end[i];
            if (inside) {
                const vec *L = functions + (i * C + col) * D;
                c[i] += dot[i] * mu[0] + L[0] * moving;
                for (int l = 0; l < np; ++l) {
                    vec by = all(0.0);
                    for (int k = 0; k < np; ++k) by += L[pair(np, k, l)] * w[g->owner[k]];
                    cx[i * n + l] += by * mu[0] + dot[i] * mu[1 + l] + L[1 + l] * moving + L[0] * moving_by[l];
                    cx[i * n + np + g->owner[l]] += L[1 + l] * mu[0] + L[0] * mu[1 + l];
                }
            }
            for (int j = 0; j < nq; ++j) {
                if (col < g->begin[j] || col >= g->end[j]) continue;
                const vec *K = functions + (j * C + col) * D;
                if (inside) {
                    const vec *L = functions + (i * C + col) * D;
                    M[i * nq + j] += L[0] * K[0];
                    cx[i * n + np + j] += dot[i] * K[0] + L[0] * dot[j];
                }
                if (at >= 0) cx[i * n + np + j] -= K[0] * mu[1 + at] + mu[0] * K[1 + at];
            }
            if (at < 0) continue;
            c[i] -= mu[0] * mu[1 + at];
            for (int l = 0; l < np; ++l) cx[i * n + l] -= mu[1 + l] * mu[1 + at] + mu[0] * mu[pair(np, at, l)];
        }
    }
    for (int i = 0; i < nq; ++i) {
        int at = (int)g->position[i];
        for (int k = 0; k < np; ++k) {
            c[i] += A[i * D + 1 + k] * w[g->owner[k]];
            cx[i * n + np + g->owner[k]] += A[i * D + 1 + k];
            for (int l = 0; l < np; ++l) cx[i * n + l] += A[i * D + pair(np, k, l)] * w[g->owner[k]];
        }
        if (at < 0) continue;
        c[i] += V[1 + at];
        for (int l = 0; l < np; ++l) cx[i * n + l] += V[pair(np, at, l)];
        for (int j = 0; j < nq; ++j) {
            c[i] -= A[j * D + 1 + at] * w[j];
            cx[i * n + np + j] -= A[j * D + 1 + at];
            for (int l = 0; l < np; ++l) cx[i * n + l] -= A[j * D + pair(np, at, l)] * w[j];
        }
    }
}

/* Accelerations (nq) of the forward model (16), in the units of the plant, and their derivatives.
 *
 * x: states (n), u: inputs (drives), force: forces that act besides (nq), by: (nq, n + drives).
 */
static void network_accelerate(const network *g, const vec *x, const vec *u, const double *force, vec *a, vec *by,
                               vec *scratch) {
    const int nq = g->nq, np = g->np, n = np + nq, D = g->jet, C = g->columns, m = g->drives, width = n + m;
    vec *functions = scratch + (g->basis + g->hidden) * D;
    vec w[MOST_COORDINATES], c[MOST_COORDINATES], M[MOST_COORDINATES * MOST_COORDINATES];
    vec cx[2 * MOST_COORDINATES * MOST_COORDINATES];
    for (int i = 0; i < nq; ++i) w[i] = g->time / g->length[i] * x[np + i];
    network_functions(g, x, scratch, functions);
    network_forces(g, w, functions, M, c, cx);
    mass_factor(nq, M);
    for (int i = 0; i < nq; ++i) a[i] = force[i] * g->length[i] / g->energy - c[i];
    for (int r = 0; r < m; ++r) a[g->drive[r]] += g->length[g->drive[r]] / g->energy * u[r];
    mass_solve(nq, M, a, 1);
    for (int i = 0; i < nq; ++i) {
        for (int j = 0; j < n; ++j) by[i * width + j] = -cx[i * n + j];
        for (int r = 0; r < m; ++r) by[i * width + n + r] = all(g->drive[r] == i);
    }
    for (int col = 0; col < C; ++col) { /* less ∂M/∂x times the accelerations */
        vec phi[1 + MOST_COORDINATES];
        for (int d = 0; d <= np; ++d) phi[d] = all(0.0);
        for (int j = 0; j < nq; ++j)
            if (col >= g->begin[j] && col < g->end[j])
                for (int d = 0; d <= np; ++d) phi[d] += functions[(j * C + col) * D + d] * a[j];
        for (int i = 0; i < nq; ++i) {
            if (col < g->begin[i] || col >= g->end[i]) continue;
            const vec *L = functions + (i * C + col) * D;
            for (int l = 0; l < np; ++l) by[i * width + l] -= L[1 + l] * phi[0] + L[0] * phi[1 + l];
        }
    }
    for (int j = 0; j < width; ++j) mass_solve(nq, M, by + j, width);
    for (int i = 0; i < nq; ++i) {
        double unit = g->length[i] / (g->time * g->time);
        a[i] *= unit;
        for (int l = 0; l < np; ++l) by[i * width + l] *= unit / g->length[g->owner[l]];
        for (int j = 0; j < nq; ++j) by[i * width + np + j] *= unit * g->time / g->length[j];
        for (int r = 0; r < m; ++r) by[i * width + n + r] *= unit * g->length[g->drive[r]] / g->energy;
    }
}

/* Numbers of type vec that `network_interval` needs. */
static size_t interval_scratch(const network *g) {
    size_t n = (size_t)(g->np + g->nq), width = n + (size_t)g->drives;
    return network_scratch(g) + 3 * n + 3 * n * width + (size_t)g->nq * width;
}

/* One interval of length h in RK4 steps: x⁺ (n) and S = ∂x⁺/∂(x, u), (n, n + m), by the chain rule. */
static void network_interval(const network *g, const vec *x0, const vec *u, const double *force, double h, int steps,
                             vec *next, vec *S, vec *scratch) {
    static const double fraction[4] = {0.0, 0.5, 0.5, 1.0}, share[4] = {1.0, 2.0, 2.0, 1.0};
    const int np = g->np, nq = g->nq, n = np + nq, width = n + g->drives, all_S = n * width;
    vec *x = scratch, *k = x + n, *sum = k + n, *at = sum + n, *K = at + all_S, *total = K + all_S;
    vec *by = total + all_S, *rest = by + nq * width;
    const double dt = h / steps;
    for (int i = 0; i < n; ++i) {
        next[i] = x0[i];
        for (int j = 0; j < width; ++j) S[i * width + j] = all(i == j);
    }
    for (int step = 0; step < steps; ++step) {
        for (int i = 0; i < n; ++i) sum[i] = k[i] = all(0.0);
        for (int i = 0; i < all_S; ++i) total[i] = K[i] = all(0.0);
        for (int stage = 0; stage < 4; ++stage) {
            double ahead = fraction[stage] * dt, part = share[stage] * dt / 6.0;
            for (int i = 0; i < n; ++i) x[i] = next[i] + ahead * k[i];
            for (int i = 0; i < all_S; ++i) at[i] = S[i] + ahead * K[i];
            network_accelerate(g, x, u, force, k + np, by, rest);
            for (int i = 0; i < np; ++i) {
                k[i] = x[np + g->owner[i]];
                memcpy(K + i * width, at + (np + g->owner[i]) * width, sizeof(vec) * (size_t)width);
            }
            for (int i = 0; i < nq; ++i) {
                const vec *row = by + i * width;
                for (int j = 0; j < width; ++j) {
                    vec value = j < n ? all(0.0) : row[j];
                    for (int l = 0; l < n; ++l) value += row[l] * at[l * width + j];
                    K[(np + i) * width + j] = value;
                }
            }
            for (int i = 0; i < n; ++i) sum[i] += part * k[i];
            for (int i = 0; i < all_S; ++i) total[i] += part * K[i];
        }
        for (int i = 0; i < n; ++i) next[i] += sum[i];
        for (int i = 0; i < all_S; ++i) S[i] += total[i];
    }
}

#endif
