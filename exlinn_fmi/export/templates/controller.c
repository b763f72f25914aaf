/* An NMPC controller with its estimator as plain data: what core.c is for a model. One tick is Algorithm 1 as
 * control/controller.py does it: measure, estimate, lay out the reference, solve, apply the first input.
 *
 * A value reference is an index into the array, which holds the measurements, the outputs and the time.
 */
#define fail solver_fail /* names that instance.c has too */
#define begin solver_begin
#define set_state solver_set_state
#include "nmpc.c"
#undef fail
#undef begin
#undef set_state

enum {
    NX = 0, FIRST_U = 0, FIRST_P = NU, N_KNOWN = NU, FIRST_DX = NU, FIRST_Y = NU, TIME = NU + NY, N_VALUES,
    M_U = FIRST_Y, /* outputs, one behind the other */
    M_QUANTITY = M_U + N_U, M_REFERENCE = M_QUANTITY + N_REFERENCED, M_ESTIMATE = M_REFERENCE + N_X,
    M_DISTURBANCE = M_ESTIMATE + N_X, M_COST = M_DISTURBANCE + N_Q, M_STAGE, M_CHANGE, M_STATUS, M_MISSING,
    M_ITERATIONS, M_KKT, M_FALLBACKS, M_SLACK, M_END, M_LEVEL /* the last two with a terminal set */
};
enum { SMOOTHNESS = 0, LOST = 3 };
enum { N_Z = N_X + N_D, GRID = 2 * HORIZON + 1, ORDERS_1 = 5, N_MOTION = N_REFERENCED * ORDERS_1, REACH = 8 };

/* A reference over one horizon on a grid of half intervals (control/reference.py). */
typedef struct {
    double time, quantity[N_REFERENCED], force[N_Q];
    double y[GRID][N_MOTION], x[GRID][N_X], u[GRID][N_U], z[GRID][N_UNKNOWN + 1];
    int branch[N_REFERENCED];
} Reference_;

/* What one tick hands to the next. */
typedef struct {
    double time; /* of the coming tick */
    int decided, branch[N_REFERENCED];
    int planned, left;
    double plan_x[HORIZON + 1][N_X], plan_u[HORIZON][N_U];
    int referenced;
    int prepared;                  /* whether the coming tick is, and is begun from these: */
    Reference_ reference, coming; /* of the last tick and of the coming one */
    int believed;
    double mean[N_Z], covariance[N_Z][N_Z];
    int applied_known;
    double applied[N_U];
    int weighed;
    double error[N_X]; /* state less reference that is expected at the coming tick */
    double P[N_X][N_X], cost, stage, kkt, slack, end, level;
    int heard;
    double measured[N_X], repeats[N_X], silent[N_X]; /* as in control/dropout.py */
    double fallbacks;
} Memory;

/* Everything that changes while the controller runs; the solver's memory comes first, for it has to be aligned. */
typedef struct {
    double solver[SOLVER_SIZE];
    double values[N_VALUES];
    double stop_time;
    Memory now, following;
    int fresh; /* whether the outputs answer the present measurements */
    int due;   /* whether the present communication point is a tick */
    int ready; /* whether the solver is prepared for it */
    int mode;
} State;

typedef void Between(void *importer, double since, double *end); /* nothing is between the ends of a step */

static const double NOMINAL[1] = {1.0};

static const nmpc_model MODEL = {MODEL_INTEGERS, MODEL_NUMBERS, MODEL_INTERVAL, N_INTEGER_WORK, N_WORK};

static void call(nmpc_function *function, const double *a, const double *b, const double *c, const double *d, double *x,
                 double *y, double *z)
{
    const double *arg[N_ARG] = {a, b, c, d};
    double *res[N_RES] = {x, y, z};
    long long iw[N_IW];
    double w[N_W];
    function(arg, res, iw, w, 0);
}

static int first_not_finite(const double *values, int first, int count)
{
    for (int i = first; i < first + count; i++) {
        if (!isfinite(values[i])) {
            return i;
        }
    }
    return -1;
}

static int finite(const double *values, int count)
{
    return first_not_finite(values, 0, count) < 0;
}

/* Solves A X = B by elimination with row exchanges, A (n, n) and B (n, m) overwritten; 0 where A is singular. */
static int eliminate(double *A, double *B, int n, int m)
{
    for (int k = 0; k < n; k++) {
        int best = k;
        for (int i = k + 1; i < n; i++) {
            best = fabs(A[i * n + k]) > fabs(A[best * n + k]) ? i : best;
        }
        if (!(fabs(A[best * n + k]) > 0.0)) {
            return 0;
        }
        for (int j = 0; j < n; j++) {
            const double swap = A[k * n + j];
            A[k * n + j] = A[best * n + j], A[best * n + j] = swap;
        }
        for (int j = 0; j < m; j++) {
            const double swap = B[k * m + j];
            B[k * m + j] = B[best * m + j], B[best * m + j] = swap;
        }
        for (int i = 0; i < n; i++) {
            const double factor = A[i * n + k] / A[k * n + k];
            for (int j = k; i != k && j < n; j++) {
                A[i * n + j] -= factor * A[k * n + j];
            }
            for (int j = 0; i != k && j < m; j++) {
                B[i * m + j] -= factor * B[k * m + j];
            }
        }
    }
    for (int k = 0; k < n; k++) {
        for (int j = 0; j < m; j++) {
            B[k * m + j] /= A[k * n + k];
        }
    }
    return 1;
}

/* ── estimation (control/estimator.py) ──────────────────────────────────────────────────────────────────────────── */

static void parameters(const double *force, double *p)
{
    memcpy(p, PARAMETERS, N_P * sizeof *p);
    memcpy(p + N_P, force, N_Q * sizeof *p);
}

static void force_of(const double *mean, double *force)
{
    memset(force, 0, N_Q * sizeof *force);
    for (int k = 0; k < N_D; k++) {
        force[DISTURBED[k]] = mean[N_X + k];
    }
}

/* Mean and covariance after a measurement, in Joseph's form; `prior` is the covariance before it. */
static void correct_belief(double *mean, double (*P)[N_Z], const double *prior, const double *y)
{
    int seen[N_X], s = 0;
    for (int i = 0; i < N_X; i++) {
        if (MEASURED[i] && isfinite(y[i])) {
            seen[s++] = i;
        }
    }
    if (!s) {
        return;
    }
    double S[N_X * N_X], K[N_X * N_Z], rest[N_Z][N_Z], left[N_Z][N_Z], off[N_X];
    for (int a = 0; a < s; a++) {
        const double turn = TURN[seen[a]];
        off[a] = y[seen[a]] - mean[seen[a]];
        off[a] -= turn > 0.0 ? nearbyint(off[a] / turn) * turn : 0.0;
        for (int b = 0; b < s; b++) {
            S[a * s + b] = prior[seen[a] * N_Z + seen[b]] + (a == b) * MEASUREMENT[seen[a]] * MEASUREMENT[seen[a]];
        }
        for (int j = 0; j < N_Z; j++) {
            K[a * N_Z + j] = prior[seen[a] * N_Z + j];
        }
    }
    if (!eliminate(S, K, s, N_Z)) {
        mean[0] = NAN;
        return;
    }
    for (int i = 0; i < N_Z; i++) {
        for (int j = 0; j < N_Z; j++) {
            rest[i][j] = i == j;
        }
        for (int a = 0; a < s; a++) {
            mean[i] += K[a * N_Z + i] * off[a];
            rest[i][seen[a]] -= K[a * N_Z + i];
        }
    }
    for (int i = 0; i < N_Z; i++) {
        for (int j = 0; j < N_Z; j++) {
            left[i][j] = 0.0;
            for (int k = 0; k < N_Z; k++) {
                left[i][j] += rest[i][k] * prior[k * N_Z + j];
            }
        }
    }
    for (int i = 0; i < N_Z; i++) {
        for (int j = 0; j < N_Z; j++) {
            double sum = 0.0;
            for (int k = 0; k < N_Z; k++) {
                sum += left[i][k] * rest[j][k];
            }
            for (int a = 0; a < s; a++) {
                sum += K[a * N_Z + i] * MEASUREMENT[seen[a]] * MEASUREMENT[seen[a]] * K[a * N_Z + j];
            }
            P[i][j] = sum;
        }
    }
}

/* The belief one sample later, with the input u held. */
static void predict(double *mean, double (*P)[N_Z], const double *u)
{
    double x[N_X], A[N_X * N_X], G[N_X * N_Q], p[N_P + N_Q], force[N_Q];
    const double h = SAMPLE;
    force_of(mean, force);
    parameters(force, p);
    call(MODEL_FUNCTION(sample), mean, u, p, &h, x, A, G);
#if KALMAN
    double F[N_Z][N_Z] = {{0}}, left[N_Z][N_Z], next[N_Z][N_Z];
    for (int i = 0; i < N_Z; i++) {
        F[i][i] = 1.0;
    }
    for (int i = 0; i < N_X; i++) {
        for (int j = 0; j < N_X; j++) {
            F[i][j] = A[j * N_X + i];
        }
        for (int k = 0; k < N_D; k++) {
            F[i][N_X + k] = G[DISTURBED[k] * N_X + i];
        }
    }
    for (int i = 0; i < N_Z; i++) {
        for (int j = 0; j < N_Z; j++) {
            left[i][j] = 0.0;
            for (int k = 0; k < N_Z; k++) {
                left[i][j] += F[i][k] * P[k][j];
            }
        }
    }
    for (int i = 0; i < N_Z; i++) {
        for (int j = 0; j < N_Z; j++) {
            double sum = 0.0;
            for (int k = 0; k < N_Z; k++) {
                sum += left[i][k] * F[j][k];
            }
            for (int c = 0; i < N_X && j < N_X && c < N_Q; c++) {
                sum += G[c * N_X + i] * FORCE[c] * G[c * N_X + j] * FORCE[c];
            }
            if (i == j) {
                sum += i < N_X ? PROCESS[i] * PROCESS[i] * SAMPLE : WALK[i - N_X] * WALK[i - N_X] * SAMPLE;
            }
            next[i][j] = sum;
        }
    }
    memcpy(P, next, sizeof next);
#else
    (void)P;
#endif
    memcpy(mean, x, sizeof x);
}

static int missing(const double *y)
{
    int count = 0;
    for (int i = 0; i < N_X; i++) {
        count += MEASURED[i] && !isfinite(y[i]);
    }
    return count;
}

/* The measurements, NAN where missing (control/dropout.py); 1 where one has been missing for too long. */
static int hear(const Memory *m, Memory *f, const double *values, double *y)
{
    int lost = 0;
    for (int i = 0; i < N_X; i++) {
        y[i] = f->measured[i] = values[i];
        f->repeats[i] = m->heard && values[i] == m->measured[i] ? m->repeats[i] + 1.0 : 0.0;
        if (STALE && m->believed && MEASURED[i] && isfinite(y[i])) {
            double off = values[i] - m->mean[i];
            if (TURN[i] > 0.0) {
                off -= rint(off / TURN[i]) * TURN[i];
            }
            if (fabs(off) > MEASUREMENT[i] && f->repeats[i] >= STALE) {
                y[i] = NAN;
            }
        }
        f->silent[i] = MEASURED[i] && !isfinite(y[i]) ? m->silent[i] + 1.0 : 0.0;
        lost |= f->silent[i] * SAMPLE > TIMEOUT[0] * (1.0 + 1e-9);
    }
    f->heard = 1;
    return lost;
}

/* What the measurements tell of the state at their time: 0 before all have come once. */
static int believe(const Memory *memory, const double *y, double *mean, double (*P)[N_Z])
{
    if (memory->believed) {
        memcpy(mean, memory->mean, sizeof memory->mean);
        memcpy(P, memory->covariance, sizeof memory->covariance);
#if KALMAN
        correct_belief(mean, P, STEADY ? STEADY_COVARIANCE : &memory->covariance[0][0], y);
#else
        for (int i = 0; i < N_X; i++) {
            mean[i] = isfinite(y[i]) ? y[i] : mean[i];
        }
#endif
        if (finite(mean, N_Z) && finite(&P[0][0], N_Z * N_Z)) {
            return 1;
        }
    }
    if (missing(y)) {
        return 0;
    }
    memset(P, 0, sizeof memory->covariance);
    for (int i = 0; i < N_Z; i++) {
        const int seen = i < N_X && MEASURED[i];
        const double deviation = seen ? MEASUREMENT[i] : FIRST[i];
        mean[i] = i >= N_X ? 0.0 : isfinite(y[i]) ? y[i] : 0.0;
        P[i][i] = deviation * deviation;
    }
    return 1;
}

/* ── the reference (control/reference.py, trajectory.py, inversion.py) ──────────────────────────────────────────── */

/* A time moved on by the width of an instant: `>= jump` then holds at the jump whatever the rounding. */
static double not_before(double t)
{
    const double size = fabs(t), width = nextafter(size, INFINITY) - size;
    return t + fmax(SAME_TIME, 8.0 * width);
}

/* The signal that is to be followed, at a time. */
static double signal_at(const Signal *s, double t)
{
    const double *v = s->numbers;
    double sum = 0.0;
    switch (s->kind) {
    case SINES: /* offset, factor, then 2 pi f and phase of each */
        for (int k = 0; k < s->count; k++) {
            sum += sin(v[2 + 2 * k] * t + v[3 + 2 * k]);
        }
        return v[0] + v[1] * sum;
    case RAMP: /* offset, slope, start, length */
        return v[0] + v[1] * fmin(fmax(t - v[2], 0.0), v[3]);
    case CHIRP: { /* offset, amplitude, first, last, duration, whether logarithmic */
        const double tau = t - v[4] * floor(not_before(t) / v[4]), ratio = v[3] / v[2];
        const double cycles = v[5] != 0.0 ? v[2] * v[4] / log(ratio) * (pow(ratio, tau / v[4]) - 1.0)
                                          : v[2] * tau + (v[3] - v[2]) * tau * tau / (2.0 * v[4]);
        return v[0] + v[1] * sin(2.0 * PI * cycles);
    }
    case CYCLE: { /* how long each is held, then the levels, again and again */
        const double place = floor(not_before(t) / v[0]);
        return v[1 + (long long)(place - s->count * floor(place / s->count))];
    }
    default: { /* TABLE: 1 if held, 0 if a line, then times, then values */
        const double *time = v + 1, *value = time + s->count, at = v[0] != 0.0 ? not_before(t) : t;
        int k = 0;
        while (k < s->count && time[k] <= at) {
            k++;
        }
        if (k == 0 || k == s->count || v[0] != 0.0) {
            return value[k > 0 ? k - 1 : 0];
        }
        return value[k - 1] + (value[k] - value[k - 1]) / (time[k] - time[k - 1]) * (t - time[k - 1]);
    }
    }
}

/* The coordinate that makes the signal's quantity, on one branch. */
static double coordinate_at(const Followed *f, double t, int branch)
{
    const double quantity = signal_at(&f->signal, t);
    if (f->through == YOKE) {
        const double reach = 1.0 - f->offset, ratio = fmin(fmax(quantity / f->gain, -reach), reach);
        return branch * PI + acos(branch % 2 == 0 ? ratio : -ratio);
    }
    return f->through == LINE ? (quantity - f->offset) / f->gain : quantity;
}

/* Value and derivatives of a sampled signal at sample `at`, which has REACH neighbours on both sides. */
static void derivatives_at(const double *samples, int at, double spacing, int orders, double *result)
{
    static const int sides[2] = {0, REACH};
    const double *window = samples + at - REACH, value = samples[at];
    double best = 0.0, chosen[REACH + 1], low = INFINITY, high = -INFINITY;
    int choice = REACH / 2;

    for (int s = 0; s <= REACH; s++) {
        best += window[choice + s] * KERNELS[REACH / 2][REACH][s];
    }
    best = fabs(best);
    for (int side = 0; side < 2; side++) {
        double rough = 0.0;
        for (int s = 0; s <= REACH; s++) {
            rough += window[sides[side] + s] * KERNELS[REACH / 2][REACH][s];
        }
        if (BIAS * fabs(rough) < best) {
            choice = sides[side], best = fabs(rough);
        }
    }
    for (int s = 0; s <= REACH; s++) {
        chosen[s] = window[choice + s] - value;
        low = fmin(low, chosen[s]), high = fmax(high, chosen[s]);
    }
    memset(result, 0, (size_t)(orders + 1) * sizeof *result);
    result[0] = value;
    if (best <= SMOOTH * (high - low) + 1e-12 * (1.0 + fabs(value))) {
        for (int p = 1; p <= orders; p++) {
            for (int s = 0; s <= REACH; s++) {
                result[p] += KERNELS[REACH - choice][p][s] * chosen[s];
            }
        }
    } else {
        const double *around = window + REACH / 2;
        double fit[3] = {0}, misfit = 0.0;
        low = INFINITY, high = -INFINITY;
        for (int k = 0; k < 3; k++) {
            for (int s = 0; s <= REACH; s++) {
                fit[k] += PARABOLA[k][s] * around[s];
            }
        }
        for (int s = 0; s <= REACH; s++) {
            const double x = s - REACH / 2;
            misfit = fmax(misfit, fabs(fit[0] + fit[1] * x + fit[2] * x * x / 2.0 - around[s]));
            low = fmin(low, around[s]), high = fmax(high, around[s]);
        }
        for (int p = 1; p <= orders && p <= 2; p++) {
            result[p] = misfit > PARABOLIC * (high - low) ? 0.0 : fit[p];
        }
    }
    double power = 1.0;
    for (int p = 1; p <= orders; p++) {
        power *= spacing;
        result[p] /= power;
    }
}

/* Referenced positions with their derivatives at `count` grid points from number `first` on. */
static void motion(double time, int first, int count, const double *measured, const int *branch, double (*y)[N_MOTION])
{
    const double spacing = SAMPLE / 2.0, begin_time = time + spacing * first;
    double samples[GRID + 2 * REACH];
    for (int r = 0; r < N_REFERENCED; r++) {
        const Followed *f = &FOLLOWED[r];
        for (int i = 0; i < count + 2 * REACH; i++) {
            samples[i] = coordinate_at(f, begin_time + spacing * (i - REACH), branch[r]);
        }
        for (int i = 0; i < count; i++) {
            double *here = y[i] + r * ORDERS_1;
            if (!f->velocity) {
                derivatives_at(samples, i + REACH, spacing, ORDERS_1 - 1, here);
                continue;
            }
            derivatives_at(samples, i + REACH, spacing, ORDERS_1 - 2, here + 1);
            here[0] = 0.0;
            if (f->position >= 0) { /* counted from the measured position, by the corrected trapezoidal rule */
                const double *last = i ? y[i - 1] + r * ORDERS_1 : NULL;
                here[0] = i ? last[0] + spacing / 2.0 * (last[1] + here[1]) +
                                  spacing * spacing / 12.0 * (last[2] - here[2])
                            : measured[f->position];
            }
        }
    }
}

/* Newton's method at `count` instants; `solved` says where it ended in a solution. */
static int newton(double (*y)[N_MOTION], double (*z)[N_UNKNOWN + 1], const double *force, int count, int *solved)
{
    int all_done = 1;
    for (int i = 0; i < count; i++) {
        solved[i] = N_UNKNOWN == 0;
        all_done &= solved[i];
    }
    double r[N_UNKNOWN + 1], J[N_UNKNOWN * N_UNKNOWN + 1], transposed[N_UNKNOWN * N_UNKNOWN + 1];
    for (int iteration = 0; iteration < 30 && !all_done; iteration++) {
        all_done = 1;
        for (int i = 0; i < count; i++) {
            call(MODEL_FUNCTION(inversion), y[i], z[i], force, NULL, r, J, NULL);
            solved[i] = 0;
            if (finite(r, N_UNKNOWN) && finite(J, N_UNKNOWN * N_UNKNOWN)) {
                double size = 0.0, moved = 0.0;
                for (int a = 0; a < N_UNKNOWN; a++) {
                    for (int b = 0; b < N_UNKNOWN; b++) {
                        transposed[a * N_UNKNOWN + b] = J[b * N_UNKNOWN + a];
                    }
                }
                if (eliminate(transposed, r, N_UNKNOWN, 1)) {
                    for (int a = 0; a < N_UNKNOWN; a++) {
                        z[i][a] -= r[a];
                    }
                } else {
                    memset(r, 0, sizeof r); /* the step of least norm, where there is none */
                }
                for (int a = 0; a < N_UNKNOWN; a++) {
                    moved = fmax(moved, fabs(r[a])), size = fmax(size, fabs(z[i][a]));
                }
                solved[i] = moved <= 1e-11 * (1.0 + size);
            }
            all_done &= solved[i];
        }
    }
    all_done = 1;
    for (int i = 0; i < count; i++) {
        if (N_UNKNOWN) {
            double size = 0.0, most = 0.0;
            call(MODEL_FUNCTION(inversion), y[i], z[i], force, NULL, r, J, NULL);
            for (int a = 0; a < N_UNKNOWN; a++) {
                most = fmax(most, fabs(r[a]));
            }
            for (int a = 0; a < N_MOTION; a++) {
                size = fmax(size, fabs(y[i][a]));
            }
            solved[i] &= finite(r, N_UNKNOWN) && most <= 1e-7 * (1.0 + size);
        }
        all_done &= solved[i];
    }
    return all_done;
}

/* Unknowns, states and inputs along the motion; z holds the guess at first. */
static void follow(double (*y)[N_MOTION], double (*z)[N_UNKNOWN + 1], double (*x)[N_X], double (*u)[N_U],
                   const double *force, int count)
{
    int solved[GRID], more[GRID];
    double guess[GRID][N_UNKNOWN + 1], again[GRID][N_UNKNOWN + 1];
    memcpy(guess, z, (size_t)count * sizeof *z);
    if (!newton(y, z, force, count, solved)) {
        for (int i = 0; i < count; i++) {
            for (int a = 0; a < N_UNKNOWN; a++) {
                again[i][a] = 1.0;
            }
        }
        newton(y, again, force, count, more);
        for (int i = 0; i < count; i++) {
            if (!solved[i]) {
                memcpy(z[i], more[i] ? again[i] : guess[i], sizeof *z);
            }
        }
    }
    for (int i = 0; i < count; i++) {
        call(MODEL_FUNCTION(completion), y[i], z[i], force, NULL, x[i], u[i], NULL);
        for (int a = 0; a < N_X; a++) {
            x[i][a] = isfinite(x[i][a]) ? x[i][a] : 0.0;
        }
        for (int a = 0; a < N_U; a++) {
            u[i][a] = isfinite(u[i][a]) ? u[i][a] : 0.0;
        }
    }
}

/* The reference over the horizon that begins at a time. */
static void refer(Reference_ *to, const Reference_ *previous, double time, const double *measured, const int *branch,
                  const double *force)
{
    int anew = !previous || fabs(time - previous->time - SAMPLE) >= 1e-6 * SAMPLE;
    for (int r = 0; r < N_REFERENCED; r++) {
        anew |= (FOLLOWED[r].velocity && FOLLOWED[r].position >= 0) || (previous && previous->branch[r] != branch[r]);
    }
    to->time = time;
    memcpy(to->branch, branch, sizeof to->branch);
    memcpy(to->force, force, sizeof to->force);
    for (int r = 0; r < N_REFERENCED; r++) {
        to->quantity[r] = signal_at(&FOLLOWED[r].signal, time);
    }
    if (anew) {
        motion(time, 0, GRID, measured, branch, to->y);
        for (int i = 0; i < GRID; i++) {
            for (int a = 0; a < N_UNKNOWN; a++) {
                to->z[i][a] = UNKNOWNS[a] < N_X ? measured[UNKNOWNS[a]] : 0.0;
            }
        }
        follow(to->y, to->z, to->x, to->u, force, GRID);
        return;
    }
    memcpy(to->y, previous->y + 2, (GRID - 2) * sizeof *to->y);
    motion(time, GRID - 2, 2, measured, branch, to->y + GRID - 2);
    memcpy(to->z, previous->z + 2, (GRID - 2) * sizeof *to->z);
    if (!memcmp(force, previous->force, sizeof to->force)) {
        memcpy(to->x, previous->x + 2, (GRID - 2) * sizeof *to->x);
        memcpy(to->u, previous->u + 2, (GRID - 2) * sizeof *to->u);
        memcpy(to->z[GRID - 2], previous->z[GRID - 2], 2 * sizeof *to->z);
        follow(to->y + GRID - 2, to->z + GRID - 2, to->x + GRID - 2, to->u + GRID - 2, force, 2);
        return;
    }
    memcpy(to->z[GRID - 2], previous->z[GRID - 1], sizeof *to->z);
    memcpy(to->z[GRID - 1], previous->z[GRID - 1], sizeof *to->z);
    follow(to->y, to->z, to->x, to->u, force, GRID);
}

/* ── one tick (control/controller.py) ───────────────────────────────────────────────────────────────────────────── */

static nmpc *solver(State *s)
{
    return (nmpc *)s->solver;
}

static double *array(State *s, const char *name)
{
    return nmpc_array(solver(s), &MODEL, name);
}

static void put(State *s, const char *name, const void *values, size_t count)
{
    memcpy(array(s, name), values, count * sizeof(double));
}

static void begin_solver(State *s)
{
    *solver(s) = HEAD_START;
    put(s, "Q", Q_WEIGHT, N_X * N_X), put(s, "R", R_WEIGHT, N_U * N_U);
    put(s, "u_min", U_MIN, N_U), put(s, "u_max", U_MAX, N_U), put(s, "u_step", U_STEP, N_U);
    put(s, "x_min", X_MIN, N_SOFT), put(s, "x_max", X_MAX, N_SOFT), put(s, "span", SPAN, N_SOFT);
    put(s, "softened", SOFT, N_SOFT), put(s, "price", PRICE, N_SOFT), put(s, "price2", PRICE_2, N_SOFT);
}

static double form_of(const double *W, const double *e, int n)
{
    double sum = 0.0;
    for (int i = 0; i < n; i++) {
        for (int j = 0; j < n; j++) {
            sum += e[i] * W[i * n + j] * e[j];
        }
    }
    return sum;
}

/* A plan moved on by one interval: the last input is held, and the model says where to. */
static void shift_plan(const double *x, const double *u, const double *force, Memory *to)
{
    double p[N_P + N_Q], end[N_X], A[N_X * N_X], G[N_X * N_Q], held[N_U];
    const double *last_x = x + HORIZON * N_X, *last_u = u + (HORIZON - 1) * N_U, h = SAMPLE;
    memcpy(held, last_u, sizeof held);
    parameters(force, p);
    call(MODEL_FUNCTION(sample), last_x, last_u, p, &h, end, A, G);
    memmove(to->plan_x, x + N_X, HORIZON * sizeof *to->plan_x);
    memcpy(to->plan_x[HORIZON], finite(end, N_X) ? end : to->plan_x[HORIZON - 1], sizeof end);
    memmove(to->plan_u, u + N_U, (HORIZON - 1) * sizeof *to->plan_u);
    memcpy(to->plan_u[HORIZON - 1], held, sizeof held);
}

/* What the solver works with, but for the measured state. */
static void put_problem(State *s, const Memory *m, const Reference_ *reference)
{
    double x[(HORIZON + 1) * N_X], u[HORIZON * N_U], p[N_P + N_Q], last[N_U];
    for (int k = 0; k <= HORIZON; k++) {
        memcpy(x + k * N_X, reference->x[2 * k], sizeof *reference->x);
    }
    for (int k = 0; k < HORIZON; k++) {
        memcpy(u + k * N_U, reference->u[2 * k + 1], sizeof *reference->u);
    }
    for (int i = 0; i < N_U; i++) {
        last[i] = m->applied_known ? m->applied[i] : NAN;
    }
    parameters(reference->force, p);
    put(s, "x_ref", x, (HORIZON + 1) * N_X), put(s, "u_ref", u, HORIZON * N_U);
    put(s, "parameters", p, N_P + N_Q), put(s, "u_last", last, N_U);
    memset(array(s, "on"), 0, HORIZON * N_U * sizeof(double));
    memset(array(s, "slew"), 0, HORIZON * N_U * sizeof(double));
    memset(array(s, "state"), 0, HORIZON * N_SOFT * sizeof(double));
    solver(s)->extend = 0;
    if (m->planned) {
        put(s, "x", m->plan_x, (HORIZON + 1) * N_X), put(s, "u", m->plan_u, HORIZON * N_U);
    }
}

/* The solution from a state, by what is prepared where anything is. */
static void solve(State *s, const Memory *m, const Reference_ *reference, const double *state)
{
    nmpc *head = solver(s);
    const int prepared = head->real_time && m->prepared;
    if (!prepared || !s->ready) {
        put_problem(s, m, reference);
    }
    if (prepared) {
        if (!s->ready) {
            nmpc_prepare(head, &MODEL);
        }
        s->ready = 0; /* it is used up */
        put(s, "x0", state, N_X);
        nmpc_feedback(head, &MODEL);
        nmpc_finish(head, &MODEL);
        if (head->status != NMPC_FAILED) {
            return;
        }
        put_problem(s, m, reference);
    }
    put(s, "x0", state, N_X);
    nmpc_solve(head, &MODEL, m->planned);
}

/* What needs no measurements of the coming tick, as `_prepare` in control/controller.py. */
static void prepare(State *s)
{
    Memory *m = &s->now;
    m->prepared = m->believed && m->planned && m->decided && m->applied_known;
    if (!m->prepared) {
        return;
    }
    double mean[N_Z], P[N_Z][N_Z], force[N_Q];
    memcpy(mean, m->mean, sizeof mean), memcpy(P, m->covariance, sizeof P);
    if (LATE) {
        predict(mean, P, m->applied);
    }
    force_of(mean, force);
    refer(&m->coming, m->referenced ? &m->reference : NULL, m->time + (SLOW ? SAMPLE : 0.0), mean, m->branch, force);
    memcpy(m->plan_x[0], mean, sizeof m->plan_x[0]);
    if (solver(s)->real_time) {
        put_problem(s, m, &m->coming);
        nmpc_prepare(solver(s), &MODEL);
    }
    s->ready = 1;
}

/* What the coming tick's outputs are, and what follows it. */
static void tick(State *s)
{
    const Memory *m = &s->now;
    Memory *f = &s->following;
    double mean[N_Z], P[N_Z][N_Z], at_tick[N_Z], state[N_X] = {0}, force[N_Q] = {0}, u[N_U];
    double y[N_X];
    int branch[N_REFERENCED];

    *f = *m;
    const int lost = hear(m, f, s->values, y), known = believe(m, y, mean, P);
    memcpy(at_tick, mean, sizeof mean);
    if (known && LATE && m->applied_known) {
        predict(mean, P, m->applied);
    }
    if (known) {
        memcpy(state, mean, sizeof state);
        force_of(mean, force);
    }
    for (int r = 0; r < N_REFERENCED; r++) {
        branch[r] = m->decided ? m->branch[r]
                    : FOLLOWED[r].through == YOKE ? (int)floor(state[FOLLOWED[r].state] / PI) : 0;
    }
    if (m->prepared) {
        f->reference = m->coming;
    } else {
        refer(&f->reference, m->referenced ? &m->reference : NULL, m->time + (SLOW ? SAMPLE : 0.0), state, branch, force);
    }
    double x0[N_X];
    for (int i = 0; i < N_X; i++) {
        x0[i] = known ? state[i] : NAN;
    }
    nmpc *head = solver(s);
    if (lost) {
        head->status = LOST, head->iterations = 0;
    } else {
        solve(s, m, &f->reference, x0);
    }
    if (lost || head->status == NMPC_FAILED) {
        f->fallbacks = m->fallbacks + 1.0;
        if (!lost && m->planned && m->left > 0) {
            memcpy(u, m->plan_u[0], sizeof u);
            shift_plan(&m->plan_x[0][0], &m->plan_u[0][0], f->reference.force, f);
            f->left = m->left - 1;
        } else {
            memcpy(u, SAFE, sizeof u);
            f->planned = 0, f->left = 0;
        }
    } else {
        const double *plan_x = array(s, "x"), *plan_u = array(s, "u");
        double ex[N_X], eu[N_U];
        memcpy(u, plan_u, sizeof u);
        shift_plan(plan_x, plan_u, f->reference.force, f);
        for (int i = 0; i < N_X; i++) {
            ex[i] = plan_x[i] - array(s, "x_to")[i];
        }
        for (int i = 0; i < N_U; i++) {
            eu[i] = plan_u[i] - array(s, "u_to")[i];
        }
        f->planned = 1, f->left = HORIZON - 1;
        f->cost = head->cost, f->kkt = head->kkt, f->slack = head->slack;
        f->stage = form_of(Q_WEIGHT, ex, N_X) + form_of(R_WEIGHT, eu, N_U);
        const double *weight = array(s, "P_end"), factor = head->riccati && TERMINAL_SET ? head->set_weight : 1.0;
        for (int i = 0; i < N_X; i++) {
            for (int j = 0; j < N_X; j++) {
                f->P[i][j] = weight[i * N_X + j] / factor;
            }
            ex[i] = plan_x[HORIZON * N_X + i] - array(s, "x_to")[HORIZON * N_X + i];
        }
        f->weighed = 1, f->end = form_of(&f->P[0][0], ex, N_X), f->level = head->level;
        for (int i = 0; i < N_X; i++) {
            f->error[i] = f->plan_x[0][i] - f->reference.x[2][i];
        }
    }
    for (int i = 0; i < N_U; i++) {
        u[i] = fmin(fmax(u[i], U_MIN[i]), U_MAX[i]);
    }
    double change = 0.0;
    if (known && m->weighed) {
        double w[N_X];
        for (int i = 0; i < N_X; i++) {
            w[i] = state[i] - f->reference.x[0][i] - m->error[i];
        }
        const double off = fmax(0.0, form_of(&m->P[0][0], w, N_X));
        change = 2.0 * sqrt(fmax(0.0, m->cost - m->stage) * off) + off;
    }
    const double *shown = SLOW ? at_tick : mean;
    const Reference_ *told = SLOW && m->referenced ? &m->reference : &f->reference;
#if SLOW
    Reference_ present;
    if (!m->referenced) {
        refer(&present, NULL, m->time, state, branch, force);
        told = &present;
    }
#endif
    double *values = s->values;
    for (int i = 0; i < N_U; i++) {
        values[M_U + i] = !SLOW ? u[i] : m->applied_known ? m->applied[i] : SAFE[i];
    }
    memcpy(values + M_QUANTITY, told->quantity, sizeof told->quantity);
    memcpy(values + M_REFERENCE, told->x[0], sizeof told->x[0]);
    for (int i = 0; i < N_X; i++) {
        values[M_ESTIMATE + i] = known ? shown[i] : 0.0;
    }
    memset(values + M_DISTURBANCE, 0, N_Q * sizeof *values);
    if (known) {
        force_of(shown, values + M_DISTURBANCE);
    }
    values[M_COST] = f->cost, values[M_STAGE] = f->stage, values[M_CHANGE] = change;
    values[M_STATUS] = (double)head->status, values[M_MISSING] = missing(y);
    values[M_ITERATIONS] = (double)head->iterations, values[M_KKT] = f->kkt;
    values[M_FALLBACKS] = f->fallbacks, values[M_SLACK] = f->slack;
#if TERMINAL_SET
    values[M_END] = f->end, values[M_LEVEL] = f->level;
#endif

    if (known && !LATE) { /* what is measured at the next tick belongs to that tick */
        predict(mean, P, u);
    }
    f->believed = known;
    if (known) {
        memcpy(f->mean, mean, sizeof mean);
        memcpy(f->covariance, P, sizeof f->covariance);
        memcpy(f->branch, branch, sizeof branch);
    }
    f->decided = m->decided || known;
    f->referenced = known;
    memcpy(f->applied, u, sizeof u), f->applied_known = 1;
    f->time = m->time + SAMPLE;
}

/* ── what instance.c asks for ───────────────────────────────────────────────────────────────────────────────────── */

static void refresh(State *s)
{
    if (!s->fresh) {
        if (s->due) {
            tick(s);
        }
        s->fresh = 1;
    }
}

static void refresh_events(State *s)
{
    refresh(s);
}

/* The first tick is at the start. */
static void start_core(State *s)
{
    memset(&s->now, 0, sizeof s->now);
    s->now.time = s->values[TIME];
    s->due = 1;
    s->fresh = s->ready = 0;
    begin_solver(s);
}

#if CLOSED
/* Moves the model that is in the loop by h, the controller's input held: its states are what is measured. */
static void move(State *s, double h)
{
    static const double node[4] = {0.0, 0.5, 0.5, 1.0}, weight[4] = {1.0, 2.0, 2.0, 1.0};
    const double ratio = ceil(h / PLANT_STEP - 1e-9), steps = ratio > 1.0 ? ratio : 1.0, dt = h / steps;
    for (double k = 0.0; h > 0.0 && k < steps; k++) {
        double x[N_X], at[N_X], slope[N_X] = {0}, sum[N_X] = {0};
        memcpy(x, s->values, sizeof x);
        for (int stage = 0; stage < 4; stage++) {
            for (int i = 0; i < N_X; i++) {
                at[i] = x[i] + node[stage] * dt * slope[i];
            }
            call(MODEL_FUNCTION(rate), at, s->values + M_U, PARAMETERS, NULL, slope, NULL, NULL);
            for (int i = 0; i < N_X; i++) {
                sum[i] += weight[stage] * slope[i];
            }
        }
        for (int i = 0; i < N_X; i++) {
            s->values[i] = x[i] + dt / 6.0 * sum[i];
        }
    }
}
#else
#define move(s, h) ((void)(s)) /* what is measured comes from outside */
#endif

/* Goes on by h; ticks on the way are made with the measurements as they are then. */
static void pass(State *s, double h)
{
    const double end = s->values[TIME] + h, instant = 1e-9 * (fabs(end) + SAMPLE);
    double at = s->values[TIME];
    refresh(s);
    if (s->due) {
        s->now = s->following;
        s->due = 0;
        prepare(s);
    }
    while (s->now.time <= end + instant) {
        move(s, s->now.time - at);
        at = s->now.time;
        if (s->now.time >= end - instant) {
            s->now.time = end; /* the importer's clock is the one that counts */
            s->due = 1;
            s->fresh = 0;
            break;
        }
        tick(s);
        s->now = s->following;
        prepare(s);
    }
    move(s, s->due ? 0.0 : end - at);
    s->values[TIME] = end;
}
