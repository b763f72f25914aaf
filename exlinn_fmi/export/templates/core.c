/* The model as plain data: one array of values, its evaluation, its tangents and its steps. Knows nothing of FMI.
 *
 * A value reference is an index into the array, which holds, one behind the other,
 *
 *     states x | inputs u | parameters p | solver_step | derivatives dx | outputs y
 *
 * x, u and p are what is known; dx and y follow from them.
 */
#include <math.h>
#include <string.h>

enum {
    FIRST_U = NX,
    FIRST_P = FIRST_U + NU,
    N_KNOWN = FIRST_P + NP,
    SOLVER_STEP = N_KNOWN,
    FIRST_DX,
    FIRST_Y = FIRST_DX + NX,
    N_VALUES = FIRST_Y + NY
};

/* Everything that changes while the model runs: a copy of this is a copy of the whole state. */
typedef struct {
    double time;
    double stop_time;
    double values[N_VALUES];
    int fresh; /* whether dx and y belong to the present x, u and p */
    int mode;
} State;

typedef int Equations(const double **arg, double **res, int *iw, double *w, int mem);

/* Calls one of the generated functions: known values and, for the tangent, a direction, to a result. */
static void call(Equations *equations, const double *known, const double *direction, double *result)
{
    const double *arg[N_ARG] = {known, direction};
    double *res[N_RES] = {result};
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

/* Brings dx and y up to date. */
static void refresh(State *s)
{
    if (!s->fresh) {
        call(MODEL_FUNCTION(evaluate), s->values, NULL, s->values + FIRST_DX);
        s->fresh = 1;
    }
}

/* One step of the classical fourth-order Runge-Kutta method: moves the states in `known` by dt, inputs held. */
static void runge_kutta(double *known, double dt)
{
    static const double node[4] = {0.0, 0.5, 0.5, 1.0}, weight[4] = {1.0, 2.0, 2.0, 1.0};
    double x[NX], slope[NX] = {0}, sum[NX] = {0};

    memcpy(x, known, sizeof x);
    for (int stage = 0; stage < 4; stage++) {
        for (int i = 0; i < NX; i++) {
            known[i] = x[i] + node[stage] * dt * slope[i];
        }
        call(MODEL_FUNCTION(derivative), known, NULL, slope);
        for (int i = 0; i < NX; i++) {
            sum[i] += weight[stage] * slope[i];
        }
    }
    for (int i = 0; i < NX; i++) {
        known[i] = x[i] + dt / 6.0 * sum[i];
    }
}

/* Moves the model by h in equal steps no longer than solver_step.
 * Returns -1, or the index of the first state that is not finite any more: then the model stays where it was. */
static int advance(State *s, double h)
{
    /* A billionth is forgiven, so that 10 ms are ten steps of 1 ms whatever the rounding. */
    const double ratio = ceil(h / s->values[SOLVER_STEP] - 1e-9);
    const double steps = ratio > 1.0 ? ratio : 1.0;
    double known[N_KNOWN];

    memcpy(known, s->values, sizeof known);
    for (double k = 0.0; k < steps; k++) {
        runge_kutta(known, h / steps);
        const int bad = first_not_finite(known, 0, NX);
        if (bad >= 0) {
            return bad;
        }
    }
    memcpy(s->values, known, sizeof known);
    s->time += h;
    s->fresh = 0;
    return -1;
}
