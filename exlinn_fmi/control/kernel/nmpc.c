/* The controller's solver: real-time iteration and sequential quadratic programming (control/solver.py says how). */
#include "nmpc.h"

#include "interior.h"
#include "network.h"

#define SHORTEST 0x1p-10 /* shortest step that the line search tries */
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
    size_t dare = dare_scratch((int)n, (int)m) + n * n + m * m;
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

/* The terminal cost at the reference's end, which has been linearised. */
static void terminal_cost(problem *p) {
    const int n = p->n, m = p->m;
    double factor = p->head->terminal;
    p->head->riccati = 0;
    if (p->head->dare) {
        double *A = p->scratch, *R = A + n * n;
        memcpy(A, p->A_end, sizeof(double) * (size_t)(n * n));
        double floor = 1e-12 * larger(1.0, largest(p->Q, n * n));
        for (int i = 0; i < m * m; ++i) R[i] = larger(p->R[i], i % (m + 1) == 0 ? floor : 0.0);
        p->head->riccati = all_finite(A, n * n) && all_finite(p->B_end, n * m) &&
                           solve_dare(n, m, A, p->B_end, p->Q, R, p->P_end, R + m * m);
        factor = FALLBACK_TERMINAL;
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

/* ── one step ──────────────────────────────────────────────────────────────────────────────────────────────────── */

static void fail(problem *p, int reason) { p->head->status = NMPC_FAILED, p->head->reason = reason; }

/* Take the whole step; u + (bound − u) is the bound up to rounding only. */
static void take_step(problem *p) {
    const int m = p->m;
    for (int i = 0; i < (p->N + 1) * p->n; ++i) p->x[i] += p->dx[i];
    for (int i = 0; i < p->N * m; ++i)
        p->u[i] = smaller(larger(p->u[i] + p->step_u[i], p->u_min[i % m]), p->u_max[i % m]);
}

static void clip_plan(problem *p) {
    for (int i = 0; i < p->N * p->m; ++i)
        p->u[i] = smaller(larger(p->u[i], p->u_min[i % p->m]), p->u_max[i % p->m]);
}

static int plan_finite(const problem *p) {
    const int n = p->n, m = p->m, N = p->N;
    return all_finite(p->x, (N + 1) * n) && all_finite(p->u, N * m) && all_finite(p->x_ref, (N + 1) * n) &&
           all_finite(p->u_ref, N * m) && all_finite(p->parameters, p->r);
}

/* Linearise at the plan and lay out what is aimed at; the plan's last state is predicted where it is missing. */
static int begin(problem *p) {
    const int n = p->n, N = p->N;
    nmpc *h = p->head;
    h->status = NMPC_SOLVED, h->reason = NMPC_FINE, h->iterations = 1;
    h->kkt = h->cost = h->slack = 0.0, h->rounds = 0, h->method = 0;
    if (!plan_finite(p)) return fail(p, NMPC_NOT_FINITE), 0;
    clip_plan(p);
    bound_references(p);
    int finite = linearise(p, p->x, p->u, N + 1);
    if (h->extend && finite) memcpy(p->x + N * n, p->next + (N - 1) * n, sizeof(double) * (size_t)n);
    h->extend = 0;
    if (!finite) return fail(p, NMPC_NO_PREDICTION), 0;
    terminal_cost(p);
    return 1;
}

static int solve_program(problem *p, int from) {
    p->head->method = solve_stages(&p->q, from);
    p->head->rounds = p->q.iterations;
    if (!p->head->method) return fail(p, NMPC_NO_STEP), 0;
    for (int k = 0; k <= p->N; ++k)
        for (int i = 0; i < p->n; ++i) p->dx[k * p->n + i] = p->x_unit[i] * p->q.dz[k * p->q.z + i];
    for (int i = 0; i < p->N * p->m; ++i) p->step_u[i] = p->u_unit[i % p->m] * p->q.du[i];
    return 1;
}

/* Cost and violation of the plan. */
static void measure(problem *p) {
    nmpc *h = p->head;
    double most = 0.0;
    h->cost = weigh(p, p->x, p->u, 0.0);
    for (int k = 1; k <= p->N; ++k)
        for (int b = 0; b < p->s; ++b)
            most = larger(most, violation(p, b, p->x[k * p->n + p->q.soft[b]]) / p->span[b] - h->allowed);
    h->slack = most;
    if (!isfinite(h->cost) || !isfinite(h->slack) || !all_finite(p->u, p->N * p->m)) fail(p, NMPC_PLAN_NOT_FINITE);
}

NMPC_API void nmpc_prepare(nmpc *head, const nmpc_model *model) {
    problem p = open_problem(head, model);
    if (!begin(&p)) return;
    build(&p);
    if (!factor(&p.q, p.N)) fail(&p, NMPC_NO_STEP);
}

NMPC_API void nmpc_feedback(nmpc *head, const nmpc_model *model) {
    problem p = open_problem(head, model);
    if (head->status == NMPC_FAILED) return;
    if (!all_finite(p.x0, p.n)) {
        fail(&p, NMPC_NOT_FINITE);
        return;
    }
    for (int i = 0; i < p.n; ++i) p.q.dz[i] = (p.x0[i] - p.x[i]) / p.x_unit[i];
    if (solve_program(&p, -1)) take_step(&p);
}

NMPC_API void nmpc_finish(nmpc *head, const nmpc_model *model) {
    problem p = open_problem(head, model);
    if (head->status == NMPC_FAILED) return;
    head->kkt = residual(&p);
    measure(&p);
}

/* The plan and its sets, one interval on; the last input is held, and where to is found by the next preparation. */
NMPC_API void nmpc_shift(nmpc *head, const nmpc_model *model) {
    problem p = open_problem(head, model);
    const size_t n = (size_t)p.n, m = (size_t)p.m, N = (size_t)p.N, s = (size_t)p.s;
    memcpy(p.u_last, p.u, sizeof(double) * m);
    memmove(p.x, p.x + n, sizeof(double) * N * n);
    memmove(p.u, p.u + m, sizeof(double) * (N - 1) * m);
    memmove(p.on, p.on + m, sizeof(double) * (N - 1) * m);
    memmove(p.slew, p.slew + m, sizeof(double) * (N - 1) * m);
    memmove(p.state, p.state + s, sizeof(double) * (N - 1) * s);
    head->extend = 1;
}

/* ── to convergence ────────────────────────────────────────────────────────────────────────────────────────────── */

static double gaps(const problem *p, const double *x) {
    double sum = 0.0;
    for (int i = 0; i < p->N * p->n; ++i) sum += fabs(p->next[i] - x[p->n + i]);
    return sum;
}

/* The next plan by a line search on an ℓ₁ merit function, linearised; `weight` of the gaps in it only grows. */
static int search(problem *p, double *weight) {
    const int n = p->n, m = p->m, N = p->N;
    double gap = gaps(p, p->x);
    double now = weigh(p, p->x, p->u, 0.0) + penalty(p, p->x, 0.0);
    double full = weigh(p, p->x, p->u, 1.0) + penalty(p, p->x, 1.0);
    if (gap > 0.0) *weight = larger(*weight, 2.0 * (full - now) / gap);
    /* The cost is quadratic: its change less its curvature is its slope. */
    double slope = full - now - weigh(p, 0, 0, 1.0) - *weight * gap;
    double rounding = 1e-12 * (1.0 + fabs(now) + *weight * gap);
    for (double length = 1.0;; length /= 2.0) {
        for (int i = 0; i < (N + 1) * n; ++i) p->x_try[i] = p->x[i] + length * p->dx[i];
        for (int i = 0; i < N * m; ++i) p->u_try[i] = p->u[i] + length * p->step_u[i];
        int finite = linearise(p, p->x_try, p->u_try, N);
        double merit = weigh(p, p->x, p->u, length) + penalty(p, p->x, length) + *weight * gaps(p, p->x_try);
        int enough = merit <= now + *weight * gap + 1e-4 * length * slope + rounding;
        /* The shortest step is taken whatever it brings: standing still would end the iteration. */
        if (enough || length <= SHORTEST) {
            memcpy(p->x, p->x_try, sizeof(double) * (size_t)((N + 1) * n));
            memcpy(p->u, p->u_try, sizeof(double) * (size_t)(N * m));
            return finite;
        }
    }
}

/* From a plan to a solution: one full step if `once`, else until the residual is below the tolerance. */
static void iterate(problem *p, int once) {
    nmpc *h = p->head;
    double weight = 0.0;
    memcpy(p->x, p->x0, sizeof(double) * (size_t)p->n);
    if (!begin(p)) return;
    for (;; ++h->iterations) {
        build(p);
        if (!solve_program(p, p->N)) return;
        h->kkt = residual(p);
        if (once || h->kkt <= h->tolerance) {
            take_step(p);
            break;
        }
        int finite = search(p, &weight);
        if (h->iterations >= h->most) {
            h->status = NMPC_LIMIT;
            break;
        }
        if (!finite) {
            ++h->iterations;
            fail(p, NMPC_NO_PREDICTION);
            return;
        }
    }
    measure(p);
}

/* A plan to start from that is none: 1: the reference, 2: standing still. */
static void start_from(problem *p, int start) {
    const int n = p->n, m = p->m, N = p->N;
    if (start == 1) {
        bound_references(p);
        memcpy(p->x, p->x_to, sizeof(double) * (size_t)((N + 1) * n));
        memcpy(p->u, p->u_to, sizeof(double) * (size_t)(N * m));
    } else {
        for (int k = 0; k <= N; ++k) memcpy(p->x + k * n, p->x0, sizeof(double) * (size_t)n);
        memset(p->u, 0, sizeof(double) * (size_t)(N * m));
    }
    memset(p->on, 0, sizeof(double) * (size_t)(N * m));
    memset(p->slew, 0, sizeof(double) * (size_t)(N * m));
    memset(p->state, 0, sizeof(double) * (size_t)(N * p->s));
    p->head->extend = 0;
}

/* Solve from x0 and the plan (`planned`), else or where that leads nowhere from the reference, then standing still. */
NMPC_API void nmpc_solve(nmpc *head, const nmpc_model *model, int planned) {
    problem p = open_problem(head, model);
    int limited = 0;
    if (planned) {
        iterate(&p, head->real_time != 0);
        if (head->status != NMPC_FAILED) return;
    }
    for (int start = 1; start < 3; ++start) {
        start_from(&p, start);
        iterate(&p, 0);
        if (head->status == NMPC_SOLVED || (head->status == NMPC_LIMIT && start == 2)) return;
        limited |= head->status == NMPC_LIMIT;
    }
    if (limited) { /* then the reference was the better start after all */
        start_from(&p, 1);
        iterate(&p, 0);
    }
}

/* ── parts, for who looks at them alone ────────────────────────────────────────────────────────────────────────── */

/* A, B and next at the plan. */
NMPC_API void nmpc_linearise(nmpc *head, const nmpc_model *model) {
    problem p = open_problem(head, model);
    bound_references(&p);
    head->status = linearise(&p, p.x, p.u, p.N + 1) ? NMPC_SOLVED : NMPC_FAILED;
}

/* The program in the arrays A … l2, with dz_0 in dz, from the sets in `on` and `state`. */
NMPC_API void nmpc_program(nmpc *head, const nmpc_model *model) {
    problem p = open_problem(head, model);
    head->status = NMPC_SOLVED;
    build_springs(&p.q);
    set_all(&p.q);
    solve_program(&p, p.N);
}
