/* The controller's solver: real-time iteration and sequential quadratic programming (control/gauss_newton.py). */
#include "problem.h"

#define SHORTEST 0x1p-10 /* shortest step that the line search tries */

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
