/* The quadratic program by a primal-dual active set on top of the Riccati recursion, started from the last set.
 *
 * Each round solves the program with the present set as equalities, then every input and softened state decides
 * anew what it does, all at once (M. Hintermüller, K. Ito, K. Kunisch, SIAM J. Optim. 13, 2002). A state or a rate
 * that is kept at its bound is held there by a stiff spring whose force is corrected until the gap has gone. Rounds
 * may go round in circles: where they no longer make the changes fewer, the interior-point method takes over.
 */
#ifndef ACTIVE_H
#define ACTIVE_H

#include "stages.h"

#define BEYOND 1e-10 /* a bound is passed, over 1 + its size */
#define PULLED 1e-11 /* a multiplier has the wrong sign, over the largest one */
#define HELD 1e-12   /* a held state is at its bound, over 1 + the bound's size */
#define CORRECTIONS 12
#define PATIENCE 5 /* rounds with no fewer changes than ever before that make a circle */

/* A held quantity: spring and force at its bound. */
static inline void hold(double stiff, double force, double bound, double *weight, double *slope) {
    *weight = stiff, *slope = force - stiff * bound;
}

/* The fixed value, or the weight and slope, that go with what was decided. */
static inline void set_input(const stages *v, int at) {
    v->fixed[at] = v->on[at] == AT_LOW ? v->u_low[at] : v->u_high[at];
}

static inline void set_rate(const stages *v, int at) {
    double bound = v->slew[at] == AT_LOW ? v->rate_low[at] : v->rate_high[at];
    if (v->slew[at] == FREE)
        v->rw[at] = v->rq[at] = 0.0;
    else
        hold(v->taut[at % v->m], v->tugged[at], bound, v->rw + at, v->rq + at);
}

static inline void set_state(const stages *v, int at) {
    const int b = at % v->s;
    switch (v->state[at]) {
    case AT_LOW: hold(v->stiff[b], v->pushed[at], v->low[at], v->sw + at, v->sq + at); break;
    case AT_HIGH: hold(v->stiff[b], v->pushed[at], v->high[at], v->sw + at, v->sq + at); break;
    case BELOW: hold(v->l2[b], -v->l1[b], v->low[at], v->sw + at, v->sq + at); break;
    case ABOVE: hold(v->l2[b], v->l1[b], v->high[at], v->sw + at, v->sq + at); break;
    default: break;
    }
}

/* Take what a set says for FREE where it is not of `kinds`, or where there is no such bound. */
static inline void check_set(long long *set, int kinds, double low, double high) {
    const double bound[] = {0.0, low, high, low, high};
    if (*set < FREE || *set > kinds || !isfinite(bound[*set])) *set = FREE;
}

/* Put sets that may come from another program in force. */
static void set_all(const stages *v) {
    for (int at = 0; at < v->N * v->m; ++at) {
        check_set(v->on + at, AT_HIGH, v->u_low[at], v->u_high[at]);
        set_input(v, at);
        v->tugged[at] = 0.0;
        if (!v->rated || at < v->m) v->slew[at] = FREE;
        check_set(v->slew + at, AT_HIGH, v->rate_low[at], v->rate_high[at]);
        set_rate(v, at);
    }
    for (int at = 0; at < v->N * v->s; ++at) {
        check_set(v->state + at, ABOVE, v->low[at], v->high[at]);
        v->pushed[at] = 0.0;
        set_state(v, at);
    }
}

static inline int passed(const stages *v, double value, double bound) {
    return value > bound + v->loose * BEYOND * (1.0 + fabs(bound));
}

/* What is not beyond its bounds does next where it is free, or held by a force (> 0: downwards). */
static inline long long decide_held(const stages *v, long long was, double value, double low, double high,
                                    double force, double rough) {
    if (was == FREE) return passed(v, value, high) ? AT_HIGH : passed(v, -value, -low) ? AT_LOW : FREE;
    if (!(high > low)) return was;
    return (was == AT_HIGH ? force : -force) < -rough ? FREE : was;
}

static inline double spring(double stiff, double force, double value, long long at, double low, double high) {
    return force + stiff * (value - (at == AT_LOW ? low : high));
}

/* What a softened state does next: within, at or beyond its bounds. */
static inline long long decide_state(const stages *v, int at, double x, double *push) {
    const int b = at % v->s;
    const long long was = v->state[at];
    const double low = v->low[at], high = v->high[at], l1 = v->l1[b], rough = v->loose * PULLED * l1;
    *push = 0.0;
    if (was == ABOVE) return passed(v, high, x) ? *push = l1, AT_HIGH : ABOVE;
    if (was == BELOW) return passed(v, x, low) ? *push = -l1, AT_LOW : BELOW;
    double force = spring(v->stiff[b], v->pushed[at], x, was, low, high);
    if (was == AT_HIGH && force > l1 + rough) return ABOVE;
    if (was == AT_LOW && -force > l1 + rough) return BELOW;
    return decide_held(v, was, x, low, high, force, rough);
}

/* Every input, rate and softened state decides anew, `changes` of them otherwise than before; returns the last node
 * that changed, −1: none. */
static int decide(const stages *v, int *changes) {
    const int z = v->z, m = v->m, s = v->s, N = v->N;
    int changed = -1;
    double scale = 0.0;
    *changes = 0;
    for (int at = 0; at < N * m; ++at)
        if (v->on[at] != FREE) scale = larger(scale, fabs(v->pull[at]));
    const double rough = v->loose * PULLED * scale;
    for (int k = 0; k < N; ++k) {
        const double *dz = v->dz + k * z;
        for (int i = 0; i < m; ++i) {
            const int at = k * m + i;
            double force = 0.0;
            if (v->on[at] != FREE) {
                force = -v->pull[at];
                for (int j = 0; j < z; ++j) force -= v->G[at * z + j] * dz[j];
            }
            long long now = decide_held(v, v->on[at], v->du[at], v->u_low[at], v->u_high[at], force, rough);
            if (now != v->on[at]) v->on[at] = now, set_input(v, at), changed = k, ++*changes;
            if (!v->rated || k == 0) continue;
            const double low = v->rate_low[at], high = v->rate_high[at], d = v->du[at] - dz[v->n + i];
            force = spring(v->taut[i], v->tugged[at], d, v->slew[at], low, high);
            now = decide_held(v, v->slew[at], d, low, high, force, rough);
            if (now != v->slew[at]) v->slew[at] = now, v->tugged[at] = 0.0, set_rate(v, at), changed = k, ++*changes;
        }
        for (int at = k * s; at < (k + 1) * s; ++at) {
            double push;
            long long now = decide_state(v, at, v->dz[(k + 1) * z + v->soft[at % s]], &push);
            if (now == v->state[at]) continue;
            v->state[at] = now, v->pushed[at] = push, set_state(v, at), changed = k + 1, ++*changes;
        }
    }
    return changed;
}

/* Correct the force of a spring by what is left of the gap; 0 where there is none. */
static inline int corrected(double stiff, double value, double bound, double *force) {
    double gap = value - bound;
    *force += stiff * gap;
    return fabs(gap) > HELD * (1.0 + fabs(bound));
}

/* Correct the forces that hold states and rates at their bounds; 0 where all are there. */
static int correct(const stages *v) {
    const int z = v->z, m = v->m, s = v->s;
    int needed = 0;
    for (int k = 0; k < v->N; ++k) {
        for (int at = k * s; at < (k + 1) * s; ++at) {
            if (v->state[at] != AT_LOW && v->state[at] != AT_HIGH) continue;
            double bound = v->state[at] == AT_LOW ? v->low[at] : v->high[at];
            needed |= corrected(v->stiff[at % s], v->dz[(k + 1) * z + v->soft[at % s]], bound, v->pushed + at);
            set_state(v, at);
        }
        for (int at = k * m; v->rated && at < (k + 1) * m; ++at) {
            if (v->slew[at] == FREE) continue;
            double bound = v->slew[at] == AT_LOW ? v->rate_low[at] : v->rate_high[at];
            needed |= corrected(v->taut[at % m], v->du[at] - v->dz[k * z + v->n + at % m], bound, v->tugged + at);
            set_rate(v, at);
        }
    }
    return needed;
}

/* Solve from the sets in force; the recursion is up to date above node `from`. 0 where rounds do not end. */
static int solve_active(stages *v, int from, int most) {
    int corrections = 0, changes, least = v->N * (2 * v->m + v->s) + 1, waited = 0;
    for (int round = 0; round < most; ++round) {
        if (from >= 0 && !factor(v, from)) return 0;
        roll(v);
        ++v->iterations;
        from = decide(v, &changes);
        if (changes < least)
            least = changes, waited = 0;
        else if (++waited == PATIENCE)
            return 0;
        while (from < 0) {
            if (!correct(v)) return all_finite(v->du, v->N * v->m) && all_finite(v->dz, (v->N + 1) * v->z);
            if (++corrections > CORRECTIONS) return 0;
            vectors(v);
            roll(v);
            from = decide(v, &changes);
        }
    }
    return 0;
}

#endif
