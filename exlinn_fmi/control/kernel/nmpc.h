/* Nonlinear model predictive control of one problem, again and again, without allocation.
 *
 * The caller gives one block of memory, aligned to 64 bytes and filled with zeros, writes sizes and options into the
 * `nmpc` at its head, asks `nmpc_size` how long it has to be (in doubles), and finds the arrays in it by
 * `nmpc_array`. The block holds no address: a copy of it is a copy of the whole state.
 *
 * A tick is `nmpc_prepare` (before the measurement: linearise, factor) and `nmpc_feedback` (with it: the quadratic
 * program), then `nmpc_finish` (how it went) and `nmpc_shift`; or `nmpc_solve`, all at once, to convergence where it
 * is asked for. See control/compiled.py.
 */
#ifndef NMPC_H
#define NMPC_H

#include <stddef.h>

#ifndef NMPC_API
#define NMPC_API
#endif

enum { NMPC_SOLVED, NMPC_LIMIT, NMPC_FAILED };
enum { NMPC_FINE, NMPC_NOT_FINITE, NMPC_NO_PREDICTION, NMPC_NO_STEP, NMPC_PLAN_NOT_FINITE };

/* One interval as CasADi generates it: (x, u, p, h) -> (x⁺, ∂x⁺/∂x, ∂x⁺/∂u), column by column. */
typedef int nmpc_function(const double **arguments, double **results, long long *iw, double *w, int memory);

/* What predicts: structured networks (integers and numbers, network.h), or else a generated function. */
typedef struct {
    const long long *integers;
    const double *numbers;
    nmpc_function *function;
    long long integer_work, work; /* lengths of iw and w */
} nmpc_model;

typedef struct {
    long long states, inputs, horizon, softened; /* n, m, N, s */
    long long parameters; /* length of p: the model's own, then the constant force on each coordinate */
    long long rated;                             /* 1: bounds on the inputs' rate */
    long long substeps;                          /* RK4 steps in an interval */
    long long most;                              /* iterations in a solve */
    long long real_time;                         /* 1: one iteration where there is a plan to start from */
    long long dare;                              /* 1: terminal cost by the Riccati equation, 0: `terminal` Q */
    long long paper;                             /* 1: inputs are weighed against 0 */
    long long status, reason;                    /* results: see the enums above */
    long long iterations;                        /* linearisations */
    long long rounds;                            /* of the quadratic program, in the last one */
    long long method;                            /* that solved it: 1 active set, 2 interior point */
    long long riccati;                           /* 1: the terminal cost does solve its equation */
    double step, tolerance, terminal;
    double set_weight; /* factor of the terminal cost that makes plans end in the terminal set; 0: there is none */
    double level;      /* result: of the terminal set */
    double kkt, cost, slack;
    double allowed;   /* violation of a bound that is not reported, over its span */
    long long extend; /* 1: the plan's last state is still to be predicted */
} nmpc;

NMPC_API size_t nmpc_size(const nmpc *head, const nmpc_model *model);
NMPC_API double *nmpc_array(nmpc *head, const nmpc_model *model, const char *name);
NMPC_API void nmpc_prepare(nmpc *head, const nmpc_model *model);
NMPC_API void nmpc_feedback(nmpc *head, const nmpc_model *model);
NMPC_API void nmpc_finish(nmpc *head, const nmpc_model *model);
NMPC_API void nmpc_shift(nmpc *head, const nmpc_model *model);
NMPC_API void nmpc_solve(nmpc *head, const nmpc_model *model, int planned);
NMPC_API void nmpc_linearise(nmpc *head, const nmpc_model *model);
NMPC_API void nmpc_program(nmpc *head, const nmpc_model *model);

#endif
