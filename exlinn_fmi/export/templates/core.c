/* The model as plain data: one array of values, its evaluation, its derivatives and its steps. Knows nothing of FMI.
 *
 * A value reference is an index into the array, which holds, one behind the other,
 *
 *     states x | inputs u | parameters p | settings | derivatives dx | outputs y | what RANGED adds | time
 *
 * x, u and p are what is known; dx and y follow from them.
 */
enum {
    FIRST_U = NX,
    FIRST_P = FIRST_U + NU,
    N_KNOWN = FIRST_P + NP,
    SOLVER_STEP = N_KNOWN,
    SOLVER_TOLERANCE,
#if RANGED
    CLAMP, /* whether the equations see x and u no farther out than the model was trained */
#endif
    FIRST_DX,
    FIRST_Y = FIRST_DX + NX,
    END_Y = FIRST_Y + NY,
#if RANGED
    MARGIN = END_Y, /* distance to the nearest end of a range, relative to the range: negative outside */
    IN_RANGE,
#endif
    TIME = END_Y + 2 * RANGED,
    N_VALUES
};

enum { SMOOTHNESS = 3 }; /* input derivatives up to this order are followed */

/* Everything that changes while the model runs: a copy of this is a copy of the whole state. */
typedef struct {
    double values[N_VALUES];
    double stop_time;
    double slopes[SMOOTHNESS][NU + 1]; /* time derivatives of the inputs, for the next communication step */
    double next_step;                  /* what DOPRI5 would try next */
    int moving;                        /* whether any of the slopes is not 0 */
    int fresh;                         /* whether dx, y and the margin belong to the present x, u and p */
    int outside;                       /* whether it was said that the model has left its range */
    int mode;
} State;

typedef int Equations(const double **arg, double **res, int *iw, double *w, int mem);

/* Calls one of the generated functions. */
static void call(Equations *equations, const double *a, const double *b, const double *c, const double *d,
                 double *first, double *second)
{
    const double *arg[N_ARG] = {a, b, c, d};
    double *res[N_RES] = {first, second};
    int iw[N_IW];
    double w[N_W];
    equations(arg, res, iw, w, 0);
}

/* Index of the first value that is not finite among `count` from `first` on, -1 if all are. */
static int first_not_finite(const double *values, int first, int count)
{
    for (int i = first; i < first + count; i++) {
        if (!isfinite(values[i])) {
            return i;
        }
    }
    return -1;
}

/* ── the range that the model was trained in ────────────────────────────────────────────────────────────── */

#if RANGED
/* The margin, and which of the ranges is the nearest; the sign of its change with that value. */
static double margin(const double *known, int *nearest, double *slope)
{
    double least = INFINITY;
    for (int k = 0; k < N_RANGES; k++) {
        const double width = HIGH[k] - LOW[k], below = known[RANGE_OF[k]] - LOW[k], above = HIGH[k] - known[RANGE_OF[k]];
        const double here = (below < above ? below : above) / width;
        if (here < least) {
            least = here;
            *nearest = k;
            *slope = (below < above ? 1.0 : -1.0) / width;
        }
    }
    return least;
}

static int clamped(const double *values)
{
    return values[CLAMP] != 0.0;
}

/* Copies the known values, each no farther out than its range; marks those that stay as they are. */
static const double *inside(const double *known, double *copy, double *kept)
{
    memcpy(copy, known, N_KNOWN * sizeof *copy);
    for (int i = 0; i < N_KNOWN; i++) {
        kept[i] = 1.0;
    }
    for (int k = 0; k < N_RANGES; k++) {
        const int i = RANGE_OF[k];
        copy[i] = known[i] < LOW[k] ? LOW[k] : known[i] > HIGH[k] ? HIGH[k] : known[i];
        kept[i] = copy[i] == known[i];
    }
    return copy;
}
#else
#define clamped(values) 0
#define inside(known, copy, kept) (known)
#endif

/* ── equations ──────────────────────────────────────────────────────────────────────────────────────────── */

/* With a network inside, the generated functions take its value and slopes at the features of position beside the
 * known values; without one they take the known values alone. */
#if NETWORK
#include "network.c"

static void evaluate_network(const double *known, double *features, double *network)
{
    call(MODEL_FUNCTION(features), known, NULL, NULL, NULL, features, NULL);
    network_value(features, NULL, network, NULL);
}
#endif

/* dx, or (dx, y), at values whose CLAMP is minded. */
static void equations(Equations *function, const double *values, double *result)
{
    double copy[N_KNOWN + 1], kept[N_KNOWN + 1];
    const double *known = clamped(values) ? inside(values, copy, kept) : values;
    (void)copy, (void)kept;
#if NETWORK
    double features[N_FEATURES], network[N_NETWORK];
    evaluate_network(known, features, network);
    call(function, known, network, NULL, NULL, result, NULL);
#else
    call(function, known, NULL, NULL, NULL, result, NULL);
#endif
    if (clamped(values)) {
        for (int k = 0; k < N_POSITIONS; k++) { /* a position moves with its velocity, whatever the model may see */
            result[k] = values[VELOCITY_OF[k]];
        }
    }
}

/* Change of (dx, y) along a direction of the known values. */
static void tangent(const double *values, const double *direction, double *result)
{
    double copy[N_KNOWN + 1], kept[N_KNOWN + 1], seed[N_KNOWN + 1];
    const double *known = clamped(values) ? inside(values, copy, kept) : values;
    for (int i = 0; i < N_KNOWN; i++) {
        seed[i] = clamped(values) ? direction[i] * kept[i] : direction[i];
    }
    (void)copy, (void)kept;
#if NETWORK
    double features[N_FEATURES], moved[N_FEATURES], network[N_NETWORK], change[N_NETWORK];
    call(MODEL_FUNCTION(features), known, NULL, NULL, NULL, features, NULL);
    call(MODEL_FUNCTION(features_tangent), known, seed, NULL, NULL, moved, NULL);
    network_value(features, moved, network, change);
    call(MODEL_FUNCTION(tangent), known, network, seed, change, result, NULL);
#else
    call(MODEL_FUNCTION(tangent), known, seed, NULL, NULL, result, NULL);
#endif
    if (clamped(values)) {
        for (int k = 0; k < N_POSITIONS; k++) {
            result[k] = direction[VELOCITY_OF[k]];
        }
    }
}

/* Change of weight'(dx, y) with each of the known values. */
static void adjoint(const double *values, const double *weight, double *result)
{
    double copy[N_KNOWN + 1], kept[N_KNOWN + 1], seed[NX + NY];
    const double *known = clamped(values) ? inside(values, copy, kept) : values;
    (void)copy, (void)kept;
    memcpy(seed, weight, sizeof seed);
    for (int k = 0; clamped(values) && k < N_POSITIONS; k++) {
        seed[k] = 0.0;
    }
#if NETWORK
    double features[N_FEATURES], network[N_NETWORK], pull[N_NETWORK], by_feature[N_FEATURES], own[N_KNOWN];
    evaluate_network(known, features, network);
    call(MODEL_FUNCTION(adjoint), known, network, seed, NULL, result, pull);
    for (int j = 0; j < N_FEATURES; j++) {
        double unit[N_FEATURES] = {0}, change[N_NETWORK], sum = 0.0;
        unit[j] = 1.0;
        network_value(features, unit, network, change);
        for (int i = 0; i < N_NETWORK; i++) {
            sum += pull[i] * change[i];
        }
        by_feature[j] = sum;
    }
    call(MODEL_FUNCTION(features_adjoint), known, by_feature, NULL, NULL, own, NULL);
    for (int i = 0; i < N_KNOWN; i++) {
        result[i] += own[i];
    }
#else
    call(MODEL_FUNCTION(adjoint), known, seed, NULL, NULL, result, NULL);
#endif
    for (int i = 0; clamped(values) && i < N_KNOWN; i++) {
        result[i] *= kept[i];
    }
    for (int k = 0; clamped(values) && k < N_POSITIONS; k++) {
        result[VELOCITY_OF[k]] += weight[k];
    }
}

/* Brings dx, y and the margin up to date. */
static void refresh(State *s)
{
    if (!s->fresh) {
        equations(MODEL_FUNCTION(evaluate), s->values, s->values + FIRST_DX);
#if RANGED
        int nearest;
        double slope;
        s->values[MARGIN] = margin(s->values, &nearest, &slope);
#endif
        s->fresh = 1;
    }
}

/* Brings the discrete output up to date: at communication points and in events, not between. */
static void refresh_events(State *s)
{
#if RANGED
    refresh(s);
    s->values[IN_RANGE] = s->values[MARGIN] >= 0.0;
#else
    (void)s;
#endif
}

static void start_core(State *s)
{
    (void)s; /* a model has nothing to prepare */
}

/* Change of all values along a direction of the known ones. */
static void tangent_of_all(State *s, const double *direction, double *change)
{
    memset(change, 0, N_VALUES * sizeof *change);
    memcpy(change, direction, N_KNOWN * sizeof *change);
    tangent(s->values, direction, change + FIRST_DX);
#if RANGED
    int nearest;
    double slope;
    margin(s->values, &nearest, &slope);
    change[MARGIN] = slope * direction[RANGE_OF[nearest]];
#endif
}

/* Change of a weighted sum of all values with each of the known ones. */
static void adjoint_of_all(State *s, const double *weight, double *change)
{
    adjoint(s->values, weight + FIRST_DX, change);
    for (int i = 0; i < N_KNOWN; i++) {
        change[i] += weight[i];
    }
#if RANGED
    int nearest;
    double slope;
    margin(s->values, &nearest, &slope);
    change[RANGE_OF[nearest]] += slope * weight[MARGIN];
#endif
}

/* ── integration ────────────────────────────────────────────────────────────────────────────────────────── */

/* Inputs at a time from the start of the communication step on, by Taylor's polynomial of what they were there. */
static void inputs_at(const State *s, const double *start, double since, double *values)
{
    if (!s->moving) {
        return;
    }
    for (int i = 0; i < NU; i++) {
        const double d1 = s->slopes[0][i], d2 = s->slopes[1][i], d3 = s->slopes[2][i];
        values[FIRST_U + i] = start[i] + since * (d1 + since / 2.0 * (d2 + since / 3.0 * d3));
    }
}

/* One step of the classical fourth-order Runge-Kutta method. */
static void runge_kutta(State *s, const double *start, double since, double dt)
{
    static const double node[4] = {0.0, 0.5, 0.5, 1.0}, weight[4] = {1.0, 2.0, 2.0, 1.0};
    double x[NX], slope[NX] = {0}, sum[NX] = {0}, *values = s->values;

    memcpy(x, values, sizeof x);
    for (int stage = 0; stage < 4; stage++) {
        for (int i = 0; i < NX; i++) {
            values[i] = x[i] + node[stage] * dt * slope[i];
        }
        inputs_at(s, start, since + node[stage] * dt, values);
        equations(MODEL_FUNCTION(derivative), values, slope);
        for (int i = 0; i < NX; i++) {
            sum[i] += weight[stage] * slope[i];
        }
    }
    for (int i = 0; i < NX; i++) {
        values[i] = x[i] + dt / 6.0 * sum[i];
    }
}

/* One try of a step of Dormand's and Prince's method 5(4): the fifth-order result, and the largest error in units of
 * what is tolerated. `worst` is the state that has it. */
static double dormand_prince(State *s, const double *start, double since, double dt, int *worst)
{
    static const double node[7] = {0.0, 0.2, 0.3, 0.8, 8.0 / 9.0, 1.0, 1.0};
    static const double a[7][6] = {
        {0},
        {1.0 / 5.0},
        {3.0 / 40.0, 9.0 / 40.0},
        {44.0 / 45.0, -56.0 / 15.0, 32.0 / 9.0},
        {19372.0 / 6561.0, -25360.0 / 2187.0, 64448.0 / 6561.0, -212.0 / 729.0},
        {9017.0 / 3168.0, -355.0 / 33.0, 46732.0 / 5247.0, 49.0 / 176.0, -5103.0 / 18656.0},
        {35.0 / 384.0, 0.0, 500.0 / 1113.0, 125.0 / 192.0, -2187.0 / 6784.0, 11.0 / 84.0},
    };
    static const double error[7] = {71.0 / 57600.0,      0.0,          -71.0 / 16695.0, 71.0 / 1920.0,
                                    -17253.0 / 339200.0, 22.0 / 525.0, -1.0 / 40.0};
    const double tolerance = s->values[SOLVER_TOLERANCE];
    double x[NX], slope[7][NX], largest = 0.0, *values = s->values;

    memcpy(x, values, sizeof x);
    for (int stage = 0; stage < 7; stage++) {
        for (int i = 0; i < NX; i++) {
            double sum = 0.0;
            for (int j = 0; j < stage; j++) {
                sum += a[stage][j] * slope[j][i];
            }
            values[i] = x[i] + dt * sum;
        }
        inputs_at(s, start, since + node[stage] * dt, values);
        equations(MODEL_FUNCTION(derivative), values, slope[stage]);
    }
    *worst = 0;
    for (int i = 0; i < NX; i++) {
        double sum = 0.0;
        for (int j = 0; j < 7; j++) {
            sum += error[j] * slope[j][i];
        }
        const double size = fmax(fmax(fabs(x[i]), fabs(values[i])), NOMINAL[i]);
        const double here = fabs(dt * sum) / (tolerance * size);
        if (!(here <= largest)) { /* NaN is the largest of all */
            largest = here;
            *worst = i;
        }
    }
    return largest;
}

/* Called after each internal step with the time since the start of the communication step; may bring its end nearer. */
typedef void Between(void *importer, double since, double *end);

/* Equal steps no longer than solver_step. */
static int fixed_steps(State *s, const double *start, double h, double *end, Between *between, void *importer)
{
    /* A billionth is forgiven, so that 10 ms are ten steps of 1 ms whatever the rounding. */
    const double ratio = ceil(h / s->values[SOLVER_STEP] - 1e-9);
    const double steps = ratio > 1.0 ? ratio : 1.0, dt = h / steps;
    const double t0 = s->values[TIME];

    for (double k = 0.0; k < steps && k * dt < *end; k++) {
        const double next = k + 1.0 < steps ? (k + 1.0) * dt : h, target = next < *end ? next : *end;
        runge_kutta(s, start, k * dt, next <= *end ? dt : *end - k * dt);
        const int bad = first_not_finite(s->values, 0, NX);
        if (bad >= 0) {
            return bad;
        }
        s->fresh = 0;
        if (between) {
            s->values[TIME] = t0 + target;
            between(importer, target, end);
        }
    }
    return -1;
}

/* Steps that keep the error of each below solver_tolerance. */
static int adaptive_steps(State *s, const double *start, double h, double *end, Between *between, void *importer)
{
    const double t0 = s->values[TIME], least = 16.0 * DBL_EPSILON * (fabs(t0) + h);
    double since = 0.0, dt = s->next_step > 0.0 ? s->next_step : s->values[SOLVER_STEP];

    while (since < *end) {
        double before[N_KNOWN];
        int worst;
        const int last = since + dt * (1.0 + 1e-9) >= *end;
        const double step = last ? *end - since : dt;
        memcpy(before, s->values, sizeof before);
        const double error = dormand_prince(s, start, since, step, &worst);
        const double factor = error > 0.0 ? 0.9 * pow(error, -0.2) : 5.0;
        if (!(error <= 1.0)) {
            memcpy(s->values, before, sizeof before);
            dt = step * (factor > 0.1 && factor < 1.0 ? factor : 0.1); /* also where the error is no number */
            if (dt < least) {
                return worst;
            }
            continue;
        }
        since = last ? *end : since + step;
        if (!last || factor < 1.0) { /* a step cut short by the end says nothing about the next */
            dt = step * (factor < 5.0 ? factor : 5.0);
        }
        s->fresh = 0;
        if (between) {
            s->values[TIME] = t0 + since;
            between(importer, since, end);
        }
    }
    s->next_step = dt;
    return -1;
}

/* Moves the model by h, or less if `between` says so; `end` is where it came to.
 * Returns -1, or the index of the first state that cannot be followed: then the model stays where it was. */
static int advance(State *s, double h, double *end, Between *between, void *importer)
{
    const State before = *s;
    double start[NU + 1];

    memcpy(start, s->values + FIRST_U, NU * sizeof *start);
    *end = h;
    const int bad = (s->values[SOLVER_TOLERANCE] > 0.0 ? adaptive_steps : fixed_steps)(s, start, h, end, between, importer);
    if (bad >= 0) {
        *s = before;
        return bad;
    }
    s->values[TIME] = before.values[TIME] + *end;
    inputs_at(s, start, *end, s->values);
    if (s->moving) { /* input derivatives hold for one step */
        memset(s->slopes, 0, sizeof s->slopes);
        s->moving = 0;
    }
    s->fresh = 0;
    return -1;
}
