/* The models of models.h as an FMI 2.0 FMU for Co-Simulation and Model Exchange; calls out of turn are errors. */

#include "fmi2FunctionTypes.h"
#include "models.h"

#define EXPORT __attribute__((visibility("default")))
typedef enum { INSTANTIATED, INITIALIZING, EVENT, CONTINUOUS, STEPPING, TERMINATED } Mode;

typedef struct {
    Values v;
    Mode mode;
    bool exchange, ended;
    double slope[10];  /* of inputs, over the next step */
    const fmi2CallbackFunctions* calls;
    char folder[4096];
} Fmu;

static fmi2Status fail(Fmu* f, const char* what) {
    f->calls->logger(f->calls->componentEnvironment, "", fmi2Error, "logStatusError", "out of turn: %s", what);
    return fmi2Error;
}
#define ALLOW(condition, name) if (!(condition)) return fail(c, name)

static void start(Fmu* f) {
    memset(&f->v, 0, sizeof f->v);
    f->v.next = INFINITY, f->mode = INSTANTIATED, f->ended = false;
    defaults(&f->v);
}

EXPORT fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                                     const fmi2CallbackFunctions* calls, fmi2Boolean visible, fmi2Boolean log) {
    (void)name; (void)guid; (void)visible; (void)log;
    Fmu* f = calls->allocateMemory(1, sizeof *f);
    f->calls = calls, f->exchange = type == fmi2ModelExchange;
    snprintf(f->folder, sizeof f->folder, "%s", strncmp(resources, "file://", 7) ? resources : resources + 7);
    start(f);
    return f;
}
EXPORT void fmi2FreeInstance(fmi2Component c) { ((Fmu*)c)->calls->freeMemory(c); }
EXPORT fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean defined, fmi2Real tolerance, fmi2Real t0,
                                      fmi2Boolean ends, fmi2Real t1) {
    (void)defined; (void)tolerance; (void)ends; (void)t1;
    ((Fmu*)c)->v.r[0] = t0;
    return fmi2OK;
}
EXPORT fmi2Status fmi2EnterInitializationMode(fmi2Component c) {
    Fmu* f = c;
    ALLOW(f->mode == INSTANTIATED, "EnterInitializationMode");
    f->mode = INITIALIZING;
#ifdef RESOURCES
    if (!load(&f->v, f->folder)) return fail(f, "no y.txt");
#endif
    return fmi2OK;
}
EXPORT fmi2Status fmi2ExitInitializationMode(fmi2Component c) {
    Fmu* f = c;
    ALLOW(f->mode == INITIALIZING, "ExitInitializationMode");
    f->mode = f->exchange ? EVENT : STEPPING;
    return fmi2OK;
}
EXPORT fmi2Status fmi2Terminate(fmi2Component c) {
    ((Fmu*)c)->mode = TERMINATED;
    return fmi2OK;
}
EXPORT fmi2Status fmi2Reset(fmi2Component c) {
    start(c);
    return fmi2OK;
}

EXPORT fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Real values[]) {
    Fmu* f = c;
    calculate(&f->v);
    for (size_t k = 0; k < n; k++) values[k] = f->v.r[vr[k]];
    return fmi2OK;
}
EXPORT fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Real values[]) {
    Fmu* f = c;
    for (size_t k = 0; k < n; k++) {
        ALLOW(f->mode != CONTINUOUS || !DISCRETE(vr[k]), "SetReal of a discrete input");
        f->v.r[vr[k]] = values[k];
    }
    return fmi2OK;
}
EXPORT fmi2Status fmi2GetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Integer values[]) {
    for (size_t k = 0; k < n; k++) values[k] = ((Fmu*)c)->v.i[vr[k]];
    return fmi2OK;
}

/* ── state ── */
EXPORT fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate* state) {
    if (!*state) *state = malloc(sizeof(Values));
    memcpy(*state, &((Fmu*)c)->v, sizeof(Values));
    return fmi2OK;
}
EXPORT fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate state) {
    Fmu* f = c;
    memcpy(&f->v, state, sizeof(Values));
    if (f->mode == EVENT) f->mode = CONTINUOUS;
    return fmi2OK;
}
EXPORT fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate* state) {
    (void)c;
    free(*state);
    *state = NULL;
    return fmi2OK;
}
EXPORT fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate state, size_t* size) {
    (void)c; (void)state;
    *size = sizeof(Values);
    return fmi2OK;
}
EXPORT fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate state, fmi2Byte data[], size_t size) {
    (void)c;
    memcpy(data, state, size);
    return fmi2OK;
}
EXPORT fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte data[], size_t size, fmi2FMUstate* state) {
    (void)c;
    *state = malloc(size);
    memcpy(*state, data, size);
    return fmi2OK;
}
#ifdef JACOBIAN
EXPORT fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference of[], size_t n,
                                               const fmi2ValueReference to[], size_t m, const fmi2Real seed[],
                                               fmi2Real result[]) {
    for (size_t j = 0; j < n; j++) {
        result[j] = 0;
        for (size_t k = 0; k < m; k++) result[j] += jacobian(&((Fmu*)c)->v, (int)of[j], (int)to[k]) * seed[k];
    }
    return fmi2OK;
}
#endif

/* ── Model Exchange ── */
EXPORT fmi2Status fmi2EnterEventMode(fmi2Component c) {
    Fmu* f = c;
    ALLOW(f->mode == CONTINUOUS, "EnterEventMode");
    f->mode = EVENT;
    return fmi2OK;
}
EXPORT fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo* info) {
    Fmu* f = c;
    ALLOW(f->mode == EVENT, "NewDiscreteStates");
    f->v.moved = false;
    event(&f->v);
    info->newDiscreteStatesNeeded = info->nominalsOfContinuousStatesChanged = fmi2False;
    info->valuesOfContinuousStatesChanged = f->v.moved, info->terminateSimulation = f->v.terminate;
    info->nextEventTimeDefined = isfinite(f->v.next), info->nextEventTime = f->v.next;
    return fmi2OK;
}
EXPORT fmi2Status fmi2EnterContinuousTimeMode(fmi2Component c) {
    Fmu* f = c;
    ALLOW(f->mode == EVENT, "EnterContinuousTimeMode");
    f->mode = CONTINUOUS;
    return fmi2OK;
}
EXPORT fmi2Status fmi2CompletedIntegratorStep(fmi2Component c, fmi2Boolean undone, fmi2Boolean* enter,
                                              fmi2Boolean* terminate) {
    Fmu* f = c;
    (void)undone;
    ALLOW(f->mode == CONTINUOUS, "CompletedIntegratorStep");
    *enter = fmi2False, *terminate = fmi2False;
#if MODEL == SWITCH
    *enter = f->v.r[X] > 90, *terminate = f->v.r[X] > 99;
#endif
    return fmi2OK;
}
EXPORT fmi2Status fmi2SetTime(fmi2Component c, fmi2Real t) {
    Fmu* f = c;
    ALLOW(f->mode == CONTINUOUS || f->mode == EVENT, "SetTime");
    f->v.r[0] = t;
    return fmi2OK;
}
EXPORT fmi2Status fmi2SetContinuousStates(fmi2Component c, const fmi2Real x[], size_t n) {
    Fmu* f = c;
    ALLOW(f->mode == CONTINUOUS && n == NX, "SetContinuousStates");
    for (size_t k = 0; k < n; k++) f->v.r[STATE[k]] = x[k];
    return fmi2OK;
}
EXPORT fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real dx[], size_t n) {
    Fmu* f = c;
    ALLOW(f->mode >= EVENT && n == NX, "GetDerivatives");
#ifdef FAULT_DERIVATIVES
    if (f->v.r[0] > 0.5) return FAULT_DERIVATIVES;
#endif
#ifdef FAULT_NAN
    if (f->v.r[0] > 0.5) { for (size_t k = 0; k < n; k++) dx[k] = NAN; return fmi2OK; }
#endif
    calculate(&f->v);
    for (size_t k = 0; k < n; k++) dx[k] = f->v.r[RATE[k]];
    return fmi2OK;
}
EXPORT fmi2Status fmi2GetEventIndicators(fmi2Component c, fmi2Real z[], size_t n) {
    Fmu* f = c;
    ALLOW(f->mode >= EVENT && n == NZ, "GetEventIndicators");
    indicators(&f->v, z);
    return fmi2OK;
}
EXPORT fmi2Status fmi2GetContinuousStates(fmi2Component c, fmi2Real x[], size_t n) {
    for (size_t k = 0; k < n; k++) x[k] = ((Fmu*)c)->v.r[STATE[k]];
    return fmi2OK;
}
EXPORT fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component c, fmi2Real x[], size_t n) {
    (void)c;
    for (size_t k = 0; k < n; k++) x[k] = 1;
    return fmi2OK;
}

/* ── Co-Simulation: Euler steps of 10 ms and events after each ── */
EXPORT fmi2Status fmi2DoStep(fmi2Component c, fmi2Real t, fmi2Real h, fmi2Boolean undone) {
    Fmu* f = c;
    (void)undone;
    ALLOW(f->mode == STEPPING && fabs(t - f->v.r[0]) < 1e-9, "DoStep");
    int steps = (int)round(h / 0.01);
    for (int k = 0; k < (steps ? steps : 1); k++) {
        euler(&f->v, h / (steps ? steps : 1));
        for (int i = 0; i < 10; i++) f->v.r[i] += f->slope[i] * h / (steps ? steps : 1);
        event(&f->v);
        if (f->v.terminate) { f->ended = true; return fmi2Discard; }
    }
    memset(f->slope, 0, sizeof f->slope);
    return fmi2OK;
}
EXPORT fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                                              const fmi2Integer order[], const fmi2Real values[]) {
    for (size_t k = 0; k < n; k++) {
        ALLOW(order[k] == 1, "SetRealInputDerivatives");
        ((Fmu*)c)->slope[vr[k]] = values[k];
    }
    return fmi2OK;
}
EXPORT fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Boolean* value) {
    (void)kind;
    *value = ((Fmu*)c)->ended;
    return fmi2OK;
}
