/* The models of models.h as an FMI 3.0 FMU for Model Exchange and Co-Simulation with Event Mode and early return;
   calls out of turn are errors. */

#include "fmi3FunctionTypes.h"
#include "models.h"

#define EXPORT __attribute__((visibility("default")))
typedef enum { INSTANTIATED, INITIALIZING, EVENT, CONTINUOUS, STEPPING, TERMINATED } Mode;

typedef struct {
    Values v;
    Mode mode;
    bool exchange, early, due;
    fmi3InstanceEnvironment environment;
    fmi3LogMessageCallback log;
    char folder[4096];
} Fmu;

static fmi3Status fail(Fmu* f, const char* what) {
    f->log(f->environment, fmi3Error, "logStatusError", what);
    return fmi3Error;
}
#define ALLOW(condition, name) if (!(condition)) return fail(c, "out of turn: " name)

static void start(Fmu* f) {
    memset(&f->v, 0, sizeof f->v);
    f->v.next = INFINITY, f->mode = INSTANTIATED, f->due = false;
    defaults(&f->v);
}
static Fmu* make(const char* resources, void* environment, fmi3LogMessageCallback log) {
    Fmu* f = calloc(1, sizeof *f);
    f->environment = environment, f->log = log;
    snprintf(f->folder, sizeof f->folder, "%s", resources);
    start(f);
    return f;
}
EXPORT fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources,
                                                 fmi3Boolean visible, fmi3Boolean logging,
                                                 fmi3InstanceEnvironment environment, fmi3LogMessageCallback log) {
    (void)name; (void)token; (void)visible; (void)logging;
    Fmu* f = make(resources, environment, log);
    f->exchange = true;
    return f;
}
EXPORT fmi3Instance fmi3InstantiateCoSimulation(
    fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible, fmi3Boolean logging,
    fmi3Boolean events, fmi3Boolean early, const fmi3ValueReference intermediate[], size_t n,
    fmi3InstanceEnvironment environment, fmi3LogMessageCallback log, fmi3IntermediateUpdateCallback update) {
    (void)name; (void)token; (void)visible; (void)logging; (void)intermediate; (void)n; (void)update;
    if (!events) { log(environment, fmi3Error, "logStatusError", "Event Mode must be used"); return NULL; }
    Fmu* f = make(resources, environment, log);
    f->early = early;
    return f;
}
EXPORT void fmi3FreeInstance(fmi3Instance c) { free(c); }
EXPORT fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean defined, fmi3Float64 tolerance,
                                              fmi3Float64 t0, fmi3Boolean ends, fmi3Float64 t1) {
    Fmu* f = c;
    (void)defined; (void)tolerance; (void)ends; (void)t1;
    ALLOW(f->mode == INSTANTIATED, "EnterInitializationMode");
    f->mode = INITIALIZING, f->v.r[0] = t0;
#ifdef RESOURCES
    if (!load(&f->v, f->folder)) return fail(f, "no y.txt");
#endif
    return fmi3OK;
}
EXPORT fmi3Status fmi3ExitInitializationMode(fmi3Instance c) {
    Fmu* f = c;
    ALLOW(f->mode == INITIALIZING, "ExitInitializationMode");
    f->mode = EVENT;
    return fmi3OK;
}
EXPORT fmi3Status fmi3Terminate(fmi3Instance c) {
    ((Fmu*)c)->mode = TERMINATED;
    return fmi3OK;
}
EXPORT fmi3Status fmi3Reset(fmi3Instance c) {
    start(c);
    return fmi3OK;
}
EXPORT fmi3Status fmi3GetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3Float64 values[],
                                 size_t size) {
    Fmu* f = c;
    ALLOW(size == n, "GetFloat64");
    calculate(&f->v);
    for (size_t k = 0; k < n; k++) values[k] = f->v.r[vr[k]];
    return fmi3OK;
}
EXPORT fmi3Status fmi3SetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                                 const fmi3Float64 values[], size_t size) {
    Fmu* f = c;
    ALLOW(size == n, "SetFloat64");
    for (size_t k = 0; k < n; k++) {
        ALLOW((f->mode != CONTINUOUS && f->mode != STEPPING) || !DISCRETE(vr[k]), "SetFloat64 of a discrete input");
        f->v.r[vr[k]] = values[k];
    }
    return fmi3OK;
}
EXPORT fmi3Status fmi3GetInt32(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3Int32 values[],
                               size_t size) {
    (void)size;
    for (size_t k = 0; k < n; k++) values[k] = ((Fmu*)c)->v.i[vr[k] - 20];
    return fmi3OK;
}

/* ── state ── */
EXPORT fmi3Status fmi3GetFMUState(fmi3Instance c, fmi3FMUState* state) {
    if (!*state) *state = malloc(sizeof(Values));
    memcpy(*state, &((Fmu*)c)->v, sizeof(Values));
    return fmi3OK;
}
EXPORT fmi3Status fmi3SetFMUState(fmi3Instance c, fmi3FMUState state) {
    memcpy(&((Fmu*)c)->v, state, sizeof(Values));
    return fmi3OK;
}
EXPORT fmi3Status fmi3FreeFMUState(fmi3Instance c, fmi3FMUState* state) {
    (void)c;
    free(*state);
    *state = NULL;
    return fmi3OK;
}
#ifdef JACOBIAN
EXPORT fmi3Status fmi3GetDirectionalDerivative(fmi3Instance c, const fmi3ValueReference of[], size_t n,
                                               const fmi3ValueReference to[], size_t m, const fmi3Float64 seed[],
                                               size_t seeds, fmi3Float64 result[], size_t results) {
    ALLOW(seeds == m && results == n, "GetDirectionalDerivative");
    for (size_t j = 0; j < n; j++) {
        result[j] = 0;
        for (size_t k = 0; k < m; k++) result[j] += jacobian(&((Fmu*)c)->v, (int)of[j], (int)to[k]) * seed[k];
    }
    return fmi3OK;
}
#endif

/* ── events ── */
EXPORT fmi3Status fmi3EnterEventMode(fmi3Instance c) {
    Fmu* f = c;
    ALLOW(f->mode == CONTINUOUS || f->mode == STEPPING, "EnterEventMode");
    f->mode = EVENT;
    return fmi3OK;
}
EXPORT fmi3Status fmi3UpdateDiscreteStates(fmi3Instance c, fmi3Boolean* again, fmi3Boolean* terminate,
                                           fmi3Boolean* nominals, fmi3Boolean* states, fmi3Boolean* defined,
                                           fmi3Float64* next) {
    Fmu* f = c;
    ALLOW(f->mode == EVENT, "UpdateDiscreteStates");
    f->v.moved = false;
    event(&f->v);
    *again = *nominals = false, *states = f->v.moved, *terminate = f->v.terminate;
    *defined = isfinite(f->v.next), *next = f->v.next;
    return fmi3OK;
}

/* ── Model Exchange ── */
EXPORT fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance c) {
    Fmu* f = c;
    ALLOW(f->mode == EVENT && f->exchange, "EnterContinuousTimeMode");
    f->mode = CONTINUOUS;
    return fmi3OK;
}
EXPORT fmi3Status fmi3CompletedIntegratorStep(fmi3Instance c, fmi3Boolean undone, fmi3Boolean* enter,
                                              fmi3Boolean* terminate) {
    Fmu* f = c;
    (void)undone;
    ALLOW(f->mode == CONTINUOUS, "CompletedIntegratorStep");
    *enter = false, *terminate = false;
#if MODEL == SWITCH
    *enter = f->v.r[X] > 90, *terminate = f->v.r[X] > 99;
#endif
    return fmi3OK;
}
EXPORT fmi3Status fmi3SetTime(fmi3Instance c, fmi3Float64 t) {
    Fmu* f = c;
    ALLOW(f->mode == CONTINUOUS, "SetTime");
    f->v.r[0] = t;
    return fmi3OK;
}
EXPORT fmi3Status fmi3SetContinuousStates(fmi3Instance c, const fmi3Float64 x[], size_t n) {
    Fmu* f = c;
    ALLOW(f->mode == CONTINUOUS && n == NX, "SetContinuousStates");
    for (size_t k = 0; k < n; k++) f->v.r[STATE[k]] = x[k];
    return fmi3OK;
}
EXPORT fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance c, fmi3Float64 dx[], size_t n) {
    Fmu* f = c;
    ALLOW((f->mode == CONTINUOUS || f->mode == EVENT) && n == NX, "GetContinuousStateDerivatives");
    calculate(&f->v);
    for (size_t k = 0; k < n; k++) dx[k] = f->v.r[RATE[k]];
    return fmi3OK;
}
EXPORT fmi3Status fmi3GetEventIndicators(fmi3Instance c, fmi3Float64 z[], size_t n) {
    Fmu* f = c;
    ALLOW((f->mode == CONTINUOUS || f->mode == EVENT) && n == NZ, "GetEventIndicators");
    indicators(&f->v, z);
    return fmi3OK;
}
EXPORT fmi3Status fmi3GetContinuousStates(fmi3Instance c, fmi3Float64 x[], size_t n) {
    for (size_t k = 0; k < n; k++) x[k] = ((Fmu*)c)->v.r[STATE[k]];
    return fmi3OK;
}
EXPORT fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance c, fmi3Float64 x[], size_t n) {
    (void)c;
    for (size_t k = 0; k < n; k++) x[k] = 1;
    return fmi3OK;
}
EXPORT fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance c, size_t* n) {
    (void)c;
    *n = NX;
    return fmi3OK;
}
EXPORT fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance c, size_t* n) {
    (void)c;
    *n = NZ;
    return fmi3OK;
}

/* ── Co-Simulation: Euler steps of 10 ms at most; returns early where an indicator has switched or time is up ── */
EXPORT fmi3Status fmi3EnterStepMode(fmi3Instance c) {
    Fmu* f = c;
    ALLOW(f->mode == EVENT && !f->exchange, "EnterStepMode");
    f->mode = STEPPING;
    return fmi3OK;
}
EXPORT fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 t, fmi3Float64 h, fmi3Boolean undone, fmi3Boolean* needed,
                             fmi3Boolean* terminate, fmi3Boolean* early, fmi3Float64* reached) {
    Fmu* f = c;
    (void)undone;
    ALLOW(f->mode == STEPPING && fabs(t - f->v.r[0]) < 1e-9, "DoStep");
    *needed = *terminate = *early = false;
    double end = t + h, before[NZ + 1], after[NZ + 1];
    while (f->v.r[0] < end - 1e-12) {
        double step = fmin(fmin(0.01, end - f->v.r[0]), fmax(f->v.next - f->v.r[0], 1e-9));
        indicators(&f->v, before);
        euler(&f->v, step);
        indicators(&f->v, after);
        bool due = f->v.r[0] >= f->v.next - 1e-12;
        for (int k = 0; k < NZ; k++) due |= (before[k] > 0) != (after[k] > 0);
        if (!due) continue;
        *needed = true;
        *early = f->early && f->v.r[0] < end - 1e-12;
        if (f->early) break;
    }
    *reached = f->v.r[0];
#ifdef COARSE  /* the time of the last of its own steps, as if they were that long */
    if (!*early) *reached = COARSE * floor(f->v.r[0] / COARSE);
#endif
#ifdef FAULT_STEP
    if (f->v.r[0] > 0.5) return FAULT_STEP;
#endif
    return fmi3OK;
}
