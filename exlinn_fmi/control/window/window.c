/* Moving horizon estimation: linearise the samples of a window, filter forwards along them, smooth backwards.
 *
 * z = (x, d): states and disturbances, as in control/moving_horizon.py. The smoother is that of Bryson and Frazier:
 * what later measurements say goes back as an adjoint, so that no covariance is inverted that may be singular.
 */
#include "nmpc.h"

#include "dense.h"
#include "network.h"

typedef struct {
    long long states, inputs, coordinates, disturbances, parameters, substeps;
    double step;
    const long long *actuated;  /* (inputs) coordinate that each input acts on */
    const long long *disturbed; /* (disturbances) coordinate that each acts on */
    const double *own;          /* (parameters) the model's own, then zeros: the force on each coordinate */
    const double *measurement;  /* (states) variance of each state's measurement; negative: it is not measured */
    const double *turn;         /* (states) a full turn of an angle, NaN of anything else */
    const double *force;        /* (coordinates) standard deviation of an unknown force, new in each sample */
    const double *added;        /* (states + disturbances) variance that a sample adds besides */
} estimator;

static int length_of(const estimator *e) { return (int)(e->states + e->disturbances); }

/* Where everything is in the work space, which is aligned to 64 bytes. */
typedef struct {
    double *following, *F, *Q;           /* (count, …) what becomes of z, by z, and the covariance of what comes to it */
    double *K, *weighed, *means, *P;     /* (count + 1, …) gain, S⁻¹ innovation, mean and covariance after it */
    double *S, *inverse, *rest, *a, *b;  /* of a correction */
    double *adjoint, *next, *model;
    long long *seen, *counts;            /* (count + 1, …) states that were measured, and how many */
    size_t size;
} space;

static size_t room(size_t count) { return (count + 7) / 8 * 8; }

static space lay_out(const estimator *e, const nmpc_model *model, int count, double *base) {
    const size_t n = (size_t)e->states, z = (size_t)length_of(e), c = (size_t)e->coordinates, k = (size_t)count;
    size_t lanes = (size_t)(model->work + model->integer_work), at = 0;
    if (model->integers) {
        network net = network_open(model->integers, model->numbers);
        lanes = LANES * (interval_scratch(&net) + n + c + n + n * (n + c));
    }
    space s;
#define PLACE(name, length) s.name = base + at, at += room(length);
    PLACE(model, lanes + n + n * n + n * c + (size_t)e->parameters)
    PLACE(following, k * z) PLACE(F, k * z * z) PLACE(Q, k * z * z)
    PLACE(K, (k + 1) * z * n) PLACE(weighed, (k + 1) * n) PLACE(means, (k + 1) * z) PLACE(P, (k + 1) * z * z)
    PLACE(S, n * n) PLACE(inverse, n * n) PLACE(rest, z * z) PLACE(a, z * z) PLACE(b, z * z)
    PLACE(adjoint, z) PLACE(next, z)
#undef PLACE
    s.seen = (long long *)(base + at), at += room((k + 1) * n);
    s.counts = (long long *)(base + at), at += room(k + 1);
    s.size = at;
    return s;
}

NMPC_API size_t window_size(const estimator *e, const nmpc_model *model, long long count) {
    return lay_out(e, model, (int)count, 0).size;
}

/* From x⁺, A and G (rows of A and G are `a` and `g` apart) to what the filter needs. */
static void place_sample(const estimator *e, const double *point, const double *x, const double *A, const double *G,
                         double *following, double *F, double *Q) {
    const int n = (int)e->states, d = (int)e->disturbances, c = (int)e->coordinates, z = n + d;
    memset(F, 0, sizeof(double) * (size_t)(z * z));
    memset(Q, 0, sizeof(double) * (size_t)(z * z));
    for (int i = 0; i < n; ++i) {
        following[i] = x[i];
        for (int j = 0; j < n; ++j) {
            F[i * z + j] = A[i * n + j];
            for (int k = 0; k < c; ++k) Q[i * z + j] += G[i * c + k] * e->force[k] * e->force[k] * G[j * c + k];
        }
        for (int j = 0; j < d; ++j) F[i * z + n + j] = G[i * c + e->disturbed[j]];
    }
    for (int j = n; j < z; ++j) following[j] = point[j], F[j * z + j] = 1.0;
    for (int i = 0; i < z; ++i) Q[i * z + i] += e->added[i];
}

static void linearise_networks(const estimator *e, const nmpc_model *model, int count, const double *points,
                               const double *u, const space *s) {
    const int n = (int)e->states, m = (int)e->inputs, c = (int)e->coordinates, z = length_of(e), width = n + c;
    static const double none[MOST_COORDINATES];
    network net = network_open(model->integers, model->numbers);
    vec *X = (vec *)s->model, *U = X + n, *next = U + c, *S = next + n, *scratch = S + n * width;
    double *x = (double *)(scratch + interval_scratch(&net)), *A = x + n, *G = A + n * n;
    for (int first = 0; first < count; first += LANES) {
        for (int l = 0; l < LANES; ++l) {
            const int k = first + l < count ? first + l : count - 1;
            for (int i = 0; i < n; ++i) LANE(X[i], l) = points[k * z + i];
            for (int i = 0; i < c; ++i) LANE(U[i], l) = 0.0;
            for (int i = 0; i < m; ++i) LANE(U[e->actuated[i]], l) += u[k * m + i];
            for (int i = 0; i < z - n; ++i) LANE(U[e->disturbed[i]], l) += points[k * z + n + i];
        }
        network_interval(&net, X, U, none, e->step, (int)e->substeps, next, S, scratch);
        for (int l = 0; l < LANES && first + l < count; ++l) {
            const int k = first + l;
            for (int i = 0; i < n; ++i) {
                x[i] = LANE(next[i], l);
                for (int j = 0; j < n; ++j) A[i * n + j] = LANE(S[i * width + j], l);
                for (int j = 0; j < c; ++j) G[i * c + j] = LANE(S[i * width + n + j], l);
            }
            place_sample(e, points + k * z, x, A, G, s->following + k * z, s->F + k * z * z, s->Q + k * z * z);
        }
    }
}

static void linearise_function(const estimator *e, const nmpc_model *model, int count, const double *points,
                               const double *u, const space *s) {
    const int n = (int)e->states, m = (int)e->inputs, c = (int)e->coordinates, z = length_of(e);
    const size_t own = (size_t)(e->parameters - c);
    double *x = s->model, *A = x + n, *G = A + n * n, *p = G + n * c, *w = p + e->parameters;
    long long *iw = (long long *)(w + model->work);
    for (int k = 0; k < count; ++k) {
        memcpy(p, e->own, sizeof(double) * (own + (size_t)c));
        for (int i = 0; i < z - n; ++i) p[own + (size_t)e->disturbed[i]] += points[k * z + n + i];
        const double *arguments[16] = {points + k * z, u + k * m, p, &e->step};
        double *results[16] = {x, s->a, s->b};
        model->function(arguments, results, iw, w, 0);
        transpose(n, n, s->a, A), transpose(c, n, s->b, G); /* CasADi stores column by column */
        place_sample(e, points + k * z, x, A, G, s->following + k * z, s->F + k * z * z, s->Q + k * z * z);
    }
}

static void linearise(const estimator *e, const nmpc_model *model, int count, const double *points, const double *u,
                      const space *s) {
    (model->integers ? linearise_networks : linearise_function)(e, model, count, points, u, s);
}

/* The shorter way round from an expected angle to a measured one. */
static double innovation(const estimator *e, int i, double measured, double expected) {
    const double difference = measured - expected, turn = e->turn[i];
    const double turns = turn > 0.0 ? rint(difference / turn) * turn : 0.0;
    return isfinite(turns) ? difference - turns : difference;
}

/* Mean and covariance after the measurements of sample k, in Joseph's form; 0 where P has grown beyond all R. */
static int correct(const estimator *e, const double *y, double *mean, double *P, int k, const space *s) {
    const int n = (int)e->states, z = length_of(e);
    long long *seen = s->seen + k * n;
    double *K = s->K + k * z * n, *weighed = s->weighed + k * n, *rest = s->rest;
    int count = 0;
    for (int i = 0; i < n; ++i)
        if (e->measurement[i] >= 0.0 && isfinite(y[i])) seen[count++] = i;
    s->counts[k] = count;
    if (!count) return 1;
    for (int a = 0; a < count; ++a)
        for (int b = 0; b < count; ++b)
            s->S[a * count + b] = P[seen[a] * z + seen[b]] + (a == b ? e->measurement[seen[a]] : 0.0);
    if (!invert(count, s->S, s->inverse)) return 0;
    for (int a = 0; a < count; ++a) {
        weighed[a] = 0.0;
        for (int b = 0; b < count; ++b)
            weighed[a] += s->inverse[a * count + b] * innovation(e, (int)seen[b], y[seen[b]], mean[seen[b]]);
        for (int i = 0; i < z; ++i) {
            K[i * n + a] = 0.0;
            for (int b = 0; b < count; ++b) K[i * n + a] += P[i * z + seen[b]] * s->inverse[b * count + a];
        }
    }
    for (int i = 0; i < z; ++i) /* P Cᵀ S⁻¹ innovation */
        for (int a = 0; a < count; ++a) s->next[i] = (a ? s->next[i] : 0.0) + P[i * z + seen[a]] * weighed[a];
    for (int i = 0; i < z; ++i) {
        mean[i] += s->next[i];
        for (int j = 0; j < z; ++j) rest[i * z + j] = i == j;
        for (int a = 0; a < count; ++a) rest[i * z + seen[a]] -= K[i * n + a];
    }
    multiply(z, z, z, rest, P, s->a);
    for (int i = 0; i < z; ++i)
        for (int j = 0; j < z; ++j) {
            double sum = 0.0;
            for (int l = 0; l < z; ++l) sum += s->a[i * z + l] * rest[j * z + l];
            for (int a = 0; a < count; ++a) sum += K[i * n + a] * e->measurement[seen[a]] * K[j * n + a];
            s->b[i * z + j] = sum;
        }
    memcpy(P, s->b, sizeof(double) * (size_t)(z * z));
    return 1;
}

/* Mean and covariance a sample later, along what was linearised at `point`. */
static void carry(const estimator *e, const double *point, const double *following, const double *F, const double *Q,
                  double *mean, double *P, const space *s) {
    const int z = length_of(e);
    for (int i = 0; i < z; ++i) {
        double sum = following[i];
        for (int j = 0; j < z; ++j) sum += F[i * z + j] * (mean[j] - point[j]);
        s->next[i] = sum;
    }
    memcpy(mean, s->next, sizeof(double) * (size_t)z);
    multiply(z, z, z, F, P, s->a);
    for (int i = 0; i < z; ++i)
        for (int j = 0; j < z; ++j) {
            double sum = Q[i * z + j];
            for (int l = 0; l < z; ++l) sum += s->a[i * z + l] * F[j * z + l];
            P[i * z + j] = sum;
        }
}

static void lose(int count, double *a) {
    for (int i = 0; i < count; ++i) a[i] = NAN;
}

/* Correct mean and P by y (n; NaN: not measured), and carry them over a sample with the input u. */
NMPC_API void window_carry(const estimator *e, const nmpc_model *model, const double *point, const double *u,
                           const double *y, double *mean, double *P, double *work) {
    space s = lay_out(e, model, 1, work);
    if (!correct(e, y, mean, P, 0, &s)) {
        lose(length_of(e), mean);
        return;
    }
    linearise(e, model, 1, point, u, &s);
    carry(e, point, s.following, s.F, s.Q, mean, P, &s);
}

/* The likeliest trajectory: Gauss-Newton steps from `points` (count, z), measured as y (count + 1, n).
 *
 * mean and P: the arrival cost at the first point, before its measurement; then the last point's.
 */
NMPC_API void window_smooth(const estimator *e, const nmpc_model *model, long long count, long long iterations,
                            double *points, const double *u, const double *y, double *mean, double *P, double *work) {
    const int n = (int)e->states, z = length_of(e), N = (int)count;
    const size_t one = sizeof(double) * (size_t)z;
    space s = lay_out(e, model, N, work);
    for (int iteration = 0; iteration < iterations; ++iteration) {
        linearise(e, model, N, points, u, &s);
        memcpy(s.means, mean, one);
        memcpy(s.P, P, one * (size_t)z);
        for (int k = 0; k <= N; ++k) {
            double *m = s.means + k * z, *C = s.P + k * z * z;
            if (!correct(e, y + k * n, m, C, k, &s)) {
                lose(z, mean);
                return;
            }
            if (k == N) break;
            memcpy(m + z, m, one);
            memcpy(C + z * z, C, one * (size_t)z);
            carry(e, points + k * z, s.following + k * z, s.F + k * z * z, s.Q + k * z * z, m + z, C + z * z, &s);
        }
        memset(s.adjoint, 0, one);
        for (int k = N; k > 0; --k) { /* s.adjoint: of z_k after its measurement */
            const double *F = s.F + (k - 1) * z * z, *C = s.P + (k - 1) * z * z, *K = s.K + k * z * n;
            for (int a = 0; a < s.counts[k]; ++a) {
                double sum = s.weighed[k * n + a];
                for (int i = 0; i < z; ++i) sum += K[i * n + a] * s.adjoint[i];
                s.a[a] = sum;
            }
            for (int a = 0; a < s.counts[k]; ++a) s.adjoint[s.seen[k * n + a]] -= s.a[a];
            for (int i = 0; i < z; ++i) {
                s.next[i] = 0.0;
                for (int j = 0; j < z; ++j) s.next[i] += F[j * z + i] * s.adjoint[j];
            }
            memcpy(s.adjoint, s.next, one);
            for (int i = 0; i < z; ++i) {
                double sum = s.means[(k - 1) * z + i];
                for (int j = 0; j < z; ++j) sum -= C[i * z + j] * s.adjoint[j];
                points[(k - 1) * z + i] = sum;
            }
        }
    }
    memcpy(mean, s.means + N * z, one);
    memcpy(P, s.P + N * z * z, one * (size_t)z);
}
