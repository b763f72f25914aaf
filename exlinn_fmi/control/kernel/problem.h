/* One optimal control problem: its arrays in one block, model, references, terminal cost, quadratic program. */
#ifndef PROBLEM_H
#define PROBLEM_H

#include "nmpc.h"

#include "interior.h"
#include "network.h"
#include "terminal.h"

#define FALLBACK_TERMINAL 10.0
#define SPREAD 1e8 /* of the curvatures of two states up to which the model's own units do */
#define STIFF 1e5 /* of the spring that holds a state at its bound, over the largest weight on it */

#define PROBLEM_ARRAYS(X)                                                                                            \
    X(x0, n) X(x_ref, (N + 1) * n) X(u_ref, N * m) X(u_last, m) X(parameters, r) X(Q, n * n) X(R, m * m)                  \
    X(u_min, m) X(u_max, m) X(u_step, m) X(x_min, s) X(x_max, s) X(span, s) X(price, s) X(price2, s) X(softened, s)  \
    X(x, (N + 1) * n) X(u, N * m) X(on, N * m) X(slew, N * m) X(state, N * s)                                                       \
    X(next, (N + 1) * n) X(A_end, n * n) X(B_end, n * m) X(P_end, n * n) X(x_to, (N + 1) * n) X(u_to, N * m)         \
    X(u_end, m) X(x_try, (N + 1) * n) X(u_try, N * m) X(dx, (N + 1) * n) X(step_u, N * m)                          \
    X(x_unit, n + m) X(u_unit, m)

typedef struct {
    nmpc *head;
    const nmpc_model *model;
    network net;
    stages q;
    int n, m, N, s, r;
#define X(name, size) double *name;
    PROBLEM_ARRAYS(X)
#undef X
    double *scratch; /* for the model and the Riccati equation */
} problem;

static size_t padded(size_t count) { return (count + 7) / 8 * 8; }

/* All arrays behind each other, each aligned; returns the length of it all. */
static size_t lay_out(problem *p, nmpc *head, const nmpc_model *model, const char *wanted, double **found) {
    const size_t n = (size_t)head->states, m = (size_t)head->inputs, N = (size_t)head->horizon;
    const size_t r = (size_t)head->parameters, s = (size_t)head->softened, z = n + (head->rated ? m : 0), rows = N * (4 * m + 2 * s);
    double *base = (double *)head;
    size_t at = padded((sizeof(nmpc) + sizeof(double) - 1) / sizeof(double));
#define PLACE(holder, name, size)                                                                                    \
    holder.name = base + at;                                                                                         \
    if (wanted && !strcmp(wanted, #name)) *found = base + at;                                                        \
    at += padded(size);
#define X(name, size) PLACE((*p), name, size)
    PROBLEM_ARRAYS(X)
#undef X
#define X(name, size) PLACE(p->q, name, size)
    STAGE_ARRAYS(X) INTERIOR_ARRAYS(X)
#undef X
    size_t lanes = 0;
    p->head = head, p->model = model;
    p->n = (int)n, p->m = (int)m, p->N = (int)N, p->s = (int)s, p->r = (int)r;
    stages *q = &p->q;
    q->n = p->n, q->m = p->m, q->N = p->N, q->s = p->s, q->z = (int)z, q->rated = (int)head->rated;
    q->interior = 0, q->iterations = 0;
    q->soft = (const long long *)p->softened;
    q->on = (long long *)p->on, q->slew = (long long *)p->slew, q->state = (long long *)p->state;
    p->scratch = base + at;
    if (model->integers) {
        p->net = network_open(model->integers, model->numbers);
        lanes = LANES * (interval_scratch(&p->net) + n + m + n + n * (n + m));
    } else
        lanes = (size_t)(model->work + model->integer_work) + n * (n + m + 1);
    size_t dare = dare_scratch((int)n, (int)m) + n * n + m * m + m + s + terminal_scratch((int)n, (int)m);
    return at + padded(lanes > dare ? lanes : dare);
}

static problem open_problem(nmpc *head, const nmpc_model *model) {
    problem p;
    lay_out(&p, head, model, 0, 0);
    return p;
}

NMPC_API size_t nmpc_size(const nmpc *head, const nmpc_model *model) {
    problem p;
    return lay_out(&p, (nmpc *)head, model, 0, 0);
}

NMPC_API double *nmpc_array(nmpc *head, const nmpc_model *model, const char *name) {
    problem p;
    double *found = 0;
    lay_out(&p, head, model, name, &found);
    return found;
}

/* ── the model ─────────────────────────────────────────────────────────────────────────────────────────────────── */

/* Where the results of node k go: x⁺, A and B, and how long the rows of these are. */
typedef struct {
    double *next, *A, *B;
    int a, b;
} place;

static place place_of(const problem *p, int k) {
    const int n = p->n, m = p->m, z = p->q.z;
    if (k == p->N) return (place){p->next + k * n, p->A_end, p->B_end, n, m};
    return (place){p->next + k * n, p->q.A + k * z * z, p->q.B + k * z * m, z, m};
}

static void linearise_networks(problem *p, const double *x, const double *u, int count) {
    const int n = p->n, m = p->m, N = p->N, width = n + m;
    vec *X = (vec *)p->scratch, *U = X + n, *next = U + m, *S = next + n, *rest = S + n * width;
    for (int first = 0; first < count; first += LANES) {
        for (int l = 0; l < LANES; ++l) {
            int k = first + l < count ? first + l : count - 1;
            const double *xk = k == N ? p->x_to + N * n : x + k * n, *uk = k == N ? p->u_end : u + k * m;
            for (int i = 0; i < n; ++i) LANE(X[i], l) = xk[i];
            for (int i = 0; i < m; ++i) LANE(U[i], l) = uk[i];
        }
        network_interval(&p->net, X, U, p->parameters + p->r - p->net.nq, p->head->step, (int)p->head->substeps, next, S, rest);
        for (int l = 0; l < LANES && first + l < count; ++l) {
            place to = place_of(p, first + l);
            for (int i = 0; i < n; ++i) {
                to.next[i] = LANE(next[i], l);
                for (int j = 0; j < n; ++j) to.A[i * to.a + j] = LANE(S[i * width + j], l);
                for (int j = 0; j < m; ++j) to.B[i * to.b + j] = LANE(S[i * width + n + j], l);
            }
        }
    }
}

static void linearise_function(problem *p, const double *x, const double *u, int count) {
    const int n = p->n, m = p->m, N = p->N;
    double *A = p->scratch, *B = A + n * n, *w = B + n * m;
    long long *iw = (long long *)(w + p->model->work);
    for (int k = 0; k < count; ++k) {
        place to = place_of(p, k);
        const double *arguments[16] = {k == N ? p->x_to + N * n : x + k * n, k == N ? p->u_end : u + k * m,
                                       p->parameters, &p->head->step};
        double *results[16] = {to.next, A, B};
        p->model->function(arguments, results, iw, w, 0);
        for (int i = 0; i < n; ++i) {
            for (int j = 0; j < n; ++j) to.A[i * to.a + j] = A[j * n + i];
            for (int j = 0; j < m; ++j) to.B[i * to.b + j] = B[j * n + i];
        }
    }
}

/* Linearise at nodes 0 … count−1 of a plan; node N is the end of the reference. 0 where that is not finite. */
static int linearise(problem *p, const double *x, const double *u, int count) {
    const int n = p->n, m = p->m, z = p->q.z;
    if (p->model->integers)
        linearise_networks(p, x, u, count);
    else
        linearise_function(p, x, u, count);
    for (int k = 0; z > n && k < p->N; ++k)
        for (int i = 0; i < m; ++i) p->q.B[(k * z + n + i) * m + i] = 1.0;
    return all_finite(p->next, p->N * n) && all_finite(p->q.A, p->N * z * z) && all_finite(p->q.B, p->N * z * m);
}

/* ── what is aimed at ──────────────────────────────────────────────────────────────────────────────────────────── */

/* References within bounds: one beyond a bound would pull against it. */
static void bound_references(problem *p) {
    const int n = p->n, m = p->m, N = p->N, s = p->s;
    memcpy(p->x_to, p->x_ref, sizeof(double) * (size_t)((N + 1) * n));
    for (int k = 0; k <= N; ++k)
        for (int b = 0; b < s; ++b) {
            double *x = p->x_to + k * n + p->q.soft[b];
            *x = smaller(larger(*x, p->x_min[b]), p->x_max[b]);
        }
    for (int i = 0; i < N * m; ++i) {
        double u = smaller(larger(p->u_ref[i], p->u_min[i % m]), p->u_max[i % m]);
        if (i >= (N - 1) * m) p->u_end[i % m] = u;
        p->u_to[i] = p->head->paper ? 0.0 : u;
    }
}

/* How far the reference's end is from its bounds: the inputs (m), then the softened states (s). */
static void find_room(const problem *p, double *room) {
    const double *x = p->x_to + p->N * p->n;
    for (int i = 0; i < p->m; ++i) room[i] = smaller(p->u_max[i] - p->u_end[i], p->u_end[i] - p->u_min[i]);
    for (int b = 0; b < p->s; ++b) {
        double at = x[p->q.soft[b]];
        room[p->m + b] = smaller(p->x_max[b] - at, at - p->x_min[b]);
    }
}

/* The terminal cost at the reference's end, which has been linearised. */
static void terminal_cost(problem *p) {
    const int n = p->n, m = p->m;
    double factor = p->head->terminal;
    p->head->riccati = 0, p->head->level = 0.0;
    if (p->head->dare) {
        double *A = p->scratch, *R = A + n * n;
        memcpy(A, p->A_end, sizeof(double) * (size_t)(n * n));
        double floor = 1e-12 * larger(1.0, largest(p->Q, n * n));
        for (int i = 0; i < m * m; ++i) R[i] = larger(p->R[i], i % (m + 1) == 0 ? floor : 0.0);
        p->head->riccati = all_finite(A, n * n) && all_finite(p->B_end, n * m) &&
                           solve_dare(n, m, A, p->B_end, p->Q, R, p->P_end, R + m * m);
        factor = FALLBACK_TERMINAL;
        if (p->head->riccati && p->head->set_weight > 0.0) {
            double *room = R + m * m, *rest = room + m + p->s;
            find_room(p, room);
            p->head->level = terminal_level(n, m, p->s, p->A_end, p->B_end, R, p->P_end, room, p->q.soft, room + m, rest);
            for (int i = 0; i < n * n; ++i) p->P_end[i] *= p->head->set_weight;
        }
    }
    if (!p->head->riccati)
        for (int i = 0; i < n * n; ++i) p->P_end[i] = factor * p->Q[i];
}

/* yᵀ W y */
static double form(int n, const double *W, const double *y) {
    double sum = 0.0;
    for (int i = 0; i < n; ++i)
        for (int j = 0; j < n; ++j) sum += y[i] * W[i * n + j] * y[j];
    return sum;
}

/* The quadratic form of the cost at x + a dx − x_to and u + a du − u_to; of the step alone where a plan is 0. */
static double weigh(const problem *p, const double *x, const double *u, double a) {
    const int n = p->n, m = p->m, N = p->N;
    double sum = 0.0, e[64];
    for (int k = 0; k <= N; ++k) {
        for (int i = 0; i < n; ++i) e[i] = (x ? x[k * n + i] - p->x_to[k * n + i] : 0.0) + a * p->dx[k * n + i];
        sum += form(n, k < N ? p->Q : p->P_end, e);
        if (k == N) break;
        for (int i = 0; i < m; ++i) e[i] = (u ? u[k * m + i] - p->u_to[k * m + i] : 0.0) + a * p->step_u[k * m + i];
        sum += form(m, p->R, e);
    }
    return sum;
}

/* How far a state is beyond its softened bound b. */
static inline double violation(const problem *p, int b, double x) {
    return larger(larger(p->x_min[b] - x, x - p->x_max[b]), 0.0);
}

static double penalty(const problem *p, const double *x, double a) {
    const int n = p->n;
    double sum = 0.0;
    for (int k = 1; k <= p->N; ++k)
        for (int b = 0; b < p->s; ++b) {
            int i = (int)p->q.soft[b];
            double v = violation(p, b, x[k * n + i] + a * p->dx[k * n + i]);
            sum += (p->price[b] + 0.5 * p->price2[b] * v) * v;
        }
    return sum;
}

/* ── the quadratic program ─────────────────────────────────────────────────────────────────────────────────────── */

static void build_bounds(problem *p) {
    stages *q = &p->q;
    const int m = p->m, N = p->N, s = p->s, n = p->n;
    for (int at = 0; at < N * m; ++at) {
        int i = at % m;
        double u = p->u[at], low = p->u_min[i], high = p->u_max[i];
        if (q->rated && at < m && isfinite(p->u_last[i])) { /* the bound itself goes before that of the rate */
            double down = p->u_last[i] - p->u_step[i], up = p->u_last[i] + p->u_step[i], whole = high;
            high = larger(smaller(high, up), low);
            low = smaller(larger(low, down), whole);
        }
        q->u_low[at] = low - u, q->u_high[at] = high - u;
        double moved = at < m ? 0.0 : u - p->u[at - m];
        q->rate_low[at] = -p->u_step[i] - moved, q->rate_high[at] = p->u_step[i] - moved;
    }
    for (int k = 0; k < N; ++k)
        for (int b = 0; b < s; ++b) {
            double x = p->x[(k + 1) * n + q->soft[b]];
            q->low[k * s + b] = p->x_min[b] - x, q->high[k * s + b] = p->x_max[b] - x;
        }
}

/* 1/√curvature to a power of two; 1 where there is none. */
static double unit_of(double curvature) {
    if (!isfinite(curvature) || !(curvature > 0.0)) return 1.0;
    return ldexp(1.0, (int)rint(-0.5 * log2(curvature)));
}

/* Units of states and inputs that cost about one, as in control/scaling.py; 0 where the model's own units do. */
static int find_units(problem *p) {
    const stages *q = &p->q;
    const int n = p->n, m = p->m, z = q->z;
    const double *B = q->B + (q->N - 1) * z * m;
    double least = INFINITY, most = 0.0;
    for (int i = 0; i < z; ++i) p->x_unit[i] = 1.0;
    for (int i = 0; i < m; ++i) p->u_unit[i] = 1.0;
    for (int i = 0; i < n; ++i) {
        double curvature = q->H_end[i * (z + 1)];
        if (isfinite(curvature) && curvature > 0.0) least = smaller(least, curvature), most = larger(most, curvature);
    }
    if (!(most > SPREAD * least)) return 0;
    for (int i = 0; i < n; ++i) p->x_unit[i] = unit_of(q->H_end[i * (z + 1)]);
    for (int i = 0; i < m; ++i) {
        double curvature = q->H_u[i * (m + 1)];
        for (int j = 0; j < n; ++j)
            for (int l = 0; l < n; ++l) curvature += B[j * m + i] * q->H_end[j * z + l] * B[l * m + i];
        p->u_unit[i] = unit_of(curvature);
        if (q->rated) p->x_unit[n + i] = p->u_unit[i];
    }
    return 1;
}

/* a (rows, columns) times left over `over` its rows and right over its columns; 0: no such factor. */
static void scale(double *a, int rows, int columns, const double *over, const double *left, const double *right) {
    for (int i = 0; i < rows; ++i)
        for (int j = 0; j < columns; ++j)
            a[i * columns + j] *= (left ? left[i] : 1.0) * (right ? right[j] : 1.0) / (over ? over[i] : 1.0);
}

/* The program in these units. All are powers of two: that rounds nothing. */
static void change_units(problem *p) {
    stages *q = &p->q;
    const int m = p->m, N = p->N, s = p->s, z = q->z;
    const double *x = p->x_unit, *u = p->u_unit;
    scale(q->H, z, z, 0, x, x), scale(q->H_end, z, z, 0, x, x), scale(q->H_u, m, m, 0, u, u);
    for (int k = 0; k < N; ++k) {
        scale(q->A + k * z * z, z, z, x, 0, x), scale(q->B + k * z * m, z, m, x, 0, u);
        scale(q->c + k * z, z, 1, x, 0, 0), scale(q->r + k * m, 1, m, 0, 0, u);
        scale(q->u_low + k * m, m, 1, u, 0, 0), scale(q->u_high + k * m, m, 1, u, 0, 0);
        scale(q->rate_low + k * m, m, 1, u, 0, 0), scale(q->rate_high + k * m, m, 1, u, 0, 0);
        for (int b = 0; b < s; ++b) q->low[k * s + b] /= x[q->soft[b]], q->high[k * s + b] /= x[q->soft[b]];
    }
    scale(q->g, N + 1, z, 0, 0, x);
    for (int b = 0; b < s; ++b) {
        double unit = x[q->soft[b]];
        q->l1[b] *= unit, q->l2[b] *= unit * unit;
    }
}

/* How stiff the springs are that hold states and rates at their bounds. */
static void build_springs(stages *q) {
    const int z = q->z, m = q->m;
    const double *B = q->B + (q->N - 1) * z * m;
    for (int b = 0; b < q->s; ++b) {
        int i = (int)q->soft[b] * (z + 1);
        q->stiff[b] = STIFF * larger(larger(q->l2[b], q->H[i]), q->H_end[i]);
    }
    for (int i = 0; i < m; ++i) {
        q->taut[i] = STIFF * q->H_u[i * (m + 1)];
        for (int j = 0; j < z; ++j)
            for (int l = 0; l < z; ++l)
                q->taut[i] += STIFF * B[j * m + i] * q->H_end[j * z + l] * B[l * m + i];
    }
}

/* The program at the plan, which has been linearised. */
static void build(problem *p) {
    stages *q = &p->q;
    const int n = p->n, m = p->m, N = p->N, s = p->s, z = q->z;
    for (int i = 0; i < n; ++i)
        for (int j = 0; j < n; ++j) {
            q->H[i * z + j] = 2.0 * p->Q[i * n + j];
            q->H_end[i * z + j] = 2.0 * p->P_end[i * n + j];
        }
    for (int i = 0; i < m * m; ++i) q->H_u[i] = 2.0 * p->R[i];
    for (int k = 0; k <= N; ++k) {
        const double *W = k < N ? q->H : q->H_end, *x = p->x + k * n, *to = p->x_to + k * n;
        for (int i = 0; i < n; ++i) {
            double sum = 0.0;
            for (int j = 0; j < n; ++j) sum += W[i * z + j] * (x[j] - to[j]);
            q->g[k * z + i] = sum;
            if (k < N) q->c[k * z + i] = p->next[k * n + i] - p->x[(k + 1) * n + i];
        }
        for (int i = 0; k < N && i < m; ++i) {
            double sum = 0.0;
            for (int j = 0; j < m; ++j) sum += q->H_u[i * m + j] * (p->u[k * m + j] - p->u_to[k * m + j]);
            q->r[k * m + i] = sum;
        }
    }
    for (int b = 0; b < s; ++b) q->l1[b] = p->price[b], q->l2[b] = p->price2[b];
    build_bounds(p);
    if (find_units(p)) change_units(p);
    build_springs(q);
    set_all(q);
    for (int i = 0; i < z; ++i) q->dz[i] = 0.0;
}

/* KKT residual at the plan with the multipliers of its program: Hessian · step, and the gaps of the dynamics; in
 * the units of the program, which cost about one. */
static double residual(const problem *p) {
    const stages *q = &p->q;
    const int n = p->n, m = p->m, N = p->N, s = p->s, z = q->z;
    double most = 0.0;
    for (int k = 0; k < N; ++k) {
        const double *W = k + 1 < N ? q->H : q->H_end, *dz = q->dz + (k + 1) * z;
        for (int i = 0; i < n; ++i) {
            double sum = 0.0;
            for (int j = 0; j < n; ++j) sum += W[i * z + j] * dz[j];
            most = larger(most, larger(fabs(sum), fabs(q->c[k * z + i])));
        }
        for (int i = 0; i < m; ++i) {
            double sum = 0.0;
            for (int j = 0; j < m; ++j) sum += q->H_u[i * m + j] * q->du[k * m + j];
            most = larger(most, fabs(sum));
        }
        for (int b = 0; b < s; ++b) {
            double low = q->low[k * s + b], high = q->high[k * s + b], d = dz[q->soft[b]];
            double was = larger(larger(low, -high), 0.0), is = larger(larger(low - d, d - high), 0.0);
            most = larger(most, q->l2[b] * fabs(is - was));
        }
    }
    return most;
}

#endif
