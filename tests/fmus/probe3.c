/* A strict FMI 3.0 Co-Simulation FMU for tests.

   dx/dt = u, y = gain u + x, a vector, and a feed-through out = in of every scalar type. A call that the state
   machine of FMI 3.0 does not allow in the present phase is an error. From t = 0.5 s on, doStep asks to end the
   simulation with FAULT_END, returns early with FAULT_EARLY. */

#include <math.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include "fmi3FunctionTypes.h"

#define EXPORT __attribute__((visibility("default")))

enum { TIME, U, GAIN, X, Y, VECTOR, REALS = VECTOR + 3 };
typedef enum { INSTANTIATED, INITIALIZING, STEPPING, TERMINATED, FAILED } Phase;

typedef struct {
    double real[REALS], start, stop;
    fmi3Float32 f32[2];
    fmi3Int8 i8[2]; fmi3UInt8 u8[2]; fmi3Int16 i16[2]; fmi3UInt16 u16[2];
    fmi3Int32 i32[2]; fmi3UInt32 u32[2]; fmi3Int64 i64[4]; fmi3UInt64 u64[2];
    fmi3Boolean boolean[2];
} State;

typedef struct {
    State s;
    Phase phase;
    int saved;
    fmi3InstanceEnvironment environment;
    fmi3LogMessageCallback log;
} Probe;

static fmi3Status fail(Probe* p, const char* function) {
    static const char* phases[] = {"instantiated", "initializing", "stepping", "terminated", "failed"};
    char text[120];
    snprintf(text, sizeof text, "%s is not allowed while %s", function, phases[p->phase]);
    p->log(p->environment, fmi3Error, "logStatusError", text);
    p->phase = FAILED;
    return fmi3Error;
}

static void defaults(Probe* p) {
    memset(&p->s, 0, sizeof p->s);
    p->s.real[GAIN] = 2;
    p->s.real[VECTOR] = 1, p->s.real[VECTOR + 1] = 2, p->s.real[VECTOR + 2] = 3;
    p->s.i64[2] = 1;
    p->phase = INSTANTIATED;
}

static void outputs(State* s) {
    s->real[Y] = s->real[GAIN] * s->real[U] + s->real[X];
    s->f32[1] = s->f32[0];
    s->i8[1] = s->i8[0], s->u8[1] = s->u8[0], s->i16[1] = s->i16[0], s->u16[1] = s->u16[0];
    s->i32[1] = s->i32[0], s->u32[1] = s->u32[0], s->i64[1] = s->i64[0], s->u64[1] = s->u64[0];
    s->i64[3] = s->i64[2];
    s->boolean[1] = s->boolean[0];
}

EXPORT const char* fmi3GetVersion(void) { return "3.0"; }

EXPORT fmi3Instance fmi3InstantiateCoSimulation(
    fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible, fmi3Boolean logging,
    fmi3Boolean events, fmi3Boolean early, const fmi3ValueReference intermediate[], size_t n,
    fmi3InstanceEnvironment environment, fmi3LogMessageCallback log, fmi3IntermediateUpdateCallback update) {
    (void)name; (void)visible; (void)logging; (void)intermediate; (void)update;
    if (events || early || n || strcmp(token, "{probe}") || resources[strlen(resources) - 1] != '/') {
        log(environment, fmi3Error, "logStatusError", "cannot be instantiated like that");
        return NULL;
    }
    Probe* p = calloc(1, sizeof *p);
    p->environment = environment;
    p->log = log;
    defaults(p);
    return p;
}

EXPORT void fmi3FreeInstance(fmi3Instance c) { free(c); }

EXPORT fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean defined, fmi3Float64 tolerance,
                                              fmi3Float64 start, fmi3Boolean stop_defined, fmi3Float64 stop) {
    Probe* p = c;
    (void)defined; (void)tolerance;
    if (p->phase != INSTANTIATED) return fail(p, "EnterInitializationMode");
    p->phase = INITIALIZING;
    p->s.real[TIME] = start;
    p->s.stop = stop_defined ? stop : INFINITY;
    return fmi3OK;
}

EXPORT fmi3Status fmi3ExitInitializationMode(fmi3Instance c) {
    Probe* p = c;
    if (p->phase != INITIALIZING) return fail(p, "ExitInitializationMode");
    p->phase = STEPPING;
    return fmi3OK;
}

EXPORT fmi3Status fmi3Terminate(fmi3Instance c) {
    Probe* p = c;
    if (p->phase != STEPPING) return fail(p, "Terminate");
    p->phase = TERMINATED;
    return fmi3OK;
}

EXPORT fmi3Status fmi3Reset(fmi3Instance c) {
    defaults(c);
    return fmi3OK;
}

EXPORT fmi3Status fmi3GetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3Float64 values[],
                                 size_t size) {
    Probe* p = c;
    size_t have = 0;
    for (size_t k = 0; k < n; k++) have += vr[k] == VECTOR ? 3 : 1;
    if (p->phase == INSTANTIATED || size != have) return fail(p, "GetFloat64");
    outputs(&p->s);
    for (size_t k = 0; k < n; k++)
        for (int i = 0; i < (vr[k] == VECTOR ? 3 : 1); i++) *values++ = p->s.real[vr[k] + i];
    return fmi3OK;
}

EXPORT fmi3Status fmi3SetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                                 const fmi3Float64 values[], size_t size) {
    Probe* p = c;
    for (size_t k = 0; k < n; k++) {
        int may = p->phase == STEPPING ? vr[k] == U : vr[k] == U || vr[k] == GAIN || vr[k] == X;
        if (!may || size != n || p->phase > STEPPING) return fail(p, "SetFloat64");
        p->s.real[vr[k]] = values[k];
    }
    return fmi3OK;
}

/* Value references of the other types: 100, 200, … for the first of each. */
#define ACCESS(Type, member, base)                                                                          \
    EXPORT fmi3Status fmi3Get##Type(fmi3Instance c, const fmi3ValueReference vr[], size_t n,                \
                                    fmi3##Type values[], size_t size) {                                     \
        Probe* p = c;                                                                                       \
        if (p->phase == INSTANTIATED || size != n) return fail(p, "Get" #Type);                             \
        outputs(&p->s);                                                                                     \
        for (size_t k = 0; k < n; k++) values[k] = p->s.member[vr[k] - base];                               \
        return fmi3OK;                                                                                      \
    }                                                                                                       \
    EXPORT fmi3Status fmi3Set##Type(fmi3Instance c, const fmi3ValueReference vr[], size_t n,                \
                                    const fmi3##Type values[], size_t size) {                               \
        Probe* p = c;                                                                                       \
        if (p->phase > STEPPING || size != n) return fail(p, "Set" #Type);                                  \
        for (size_t k = 0; k < n; k++) p->s.member[vr[k] - base] = values[k];                               \
        return fmi3OK;                                                                                      \
    }
ACCESS(Float32, f32, 100)
ACCESS(Int8, i8, 200)
ACCESS(UInt8, u8, 300)
ACCESS(Int16, i16, 400)
ACCESS(UInt16, u16, 500)
ACCESS(Int32, i32, 600)
ACCESS(UInt32, u32, 700)
ACCESS(Int64, i64, 800)
ACCESS(UInt64, u64, 900)
ACCESS(Boolean, boolean, 1000)

EXPORT fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 t, fmi3Float64 h, fmi3Boolean no_set_state,
                             fmi3Boolean* event, fmi3Boolean* end, fmi3Boolean* early, fmi3Float64* reached) {
    Probe* p = c;
    if (p->phase != STEPPING || fabs(t - p->s.real[TIME]) > 1e-9 || t + h > p->s.stop + 1e-9)
        return fail(p, "DoStep");
    if (p->saved && no_set_state) return fail(p, "DoStep without undo");
    *event = *end = *early = false;
#ifdef FAULT_END
    *end = t + h > 0.5 - 1e-9;
#endif
#ifdef FAULT_EARLY
    *early = t + h > 0.5 - 1e-9;
#endif
    p->s.real[X] += h * p->s.real[U];
    *reached = p->s.real[TIME] = t + h;
    return fmi3OK;
}

EXPORT fmi3Status fmi3GetFMUState(fmi3Instance c, fmi3FMUState* state) {
    if (!*state) { *state = malloc(sizeof(State)); ((Probe*)c)->saved++; }
    memcpy(*state, &((Probe*)c)->s, sizeof(State));
    return fmi3OK;
}

EXPORT fmi3Status fmi3SetFMUState(fmi3Instance c, fmi3FMUState state) {
    memcpy(&((Probe*)c)->s, state, sizeof(State));
    return fmi3OK;
}

EXPORT fmi3Status fmi3FreeFMUState(fmi3Instance c, fmi3FMUState* state) {
    ((Probe*)c)->saved--;
    free(*state);
    *state = NULL;
    return fmi3OK;
}

/* Functions that FMPy wants to find and nothing calls. */
#define UNUSED(name) EXPORT fmi3Status fmi3##name(fmi3Instance c) { return fail(c, #name); }
UNUSED(SetDebugLogging)
UNUSED(InstantiateModelExchange)
UNUSED(InstantiateScheduledExecution)
UNUSED(EnterEventMode)
UNUSED(GetString)
UNUSED(SetString)
UNUSED(GetBinary)
UNUSED(SetBinary)
UNUSED(GetClock)
UNUSED(SetClock)
UNUSED(GetNumberOfVariableDependencies)
UNUSED(GetVariableDependencies)
UNUSED(SerializedFMUStateSize)
UNUSED(SerializeFMUState)
UNUSED(DeserializeFMUState)
UNUSED(GetDirectionalDerivative)
UNUSED(GetAdjointDerivative)
UNUSED(EnterConfigurationMode)
UNUSED(ExitConfigurationMode)
UNUSED(GetIntervalDecimal)
UNUSED(GetIntervalFraction)
UNUSED(GetShiftDecimal)
UNUSED(GetShiftFraction)
UNUSED(SetIntervalDecimal)
UNUSED(SetIntervalFraction)
UNUSED(SetShiftDecimal)
UNUSED(SetShiftFraction)
UNUSED(EvaluateDiscreteStates)
UNUSED(UpdateDiscreteStates)
UNUSED(EnterContinuousTimeMode)
UNUSED(CompletedIntegratorStep)
UNUSED(SetTime)
UNUSED(SetContinuousStates)
UNUSED(GetContinuousStateDerivatives)
UNUSED(GetEventIndicators)
UNUSED(GetContinuousStates)
UNUSED(GetNominalsOfContinuousStates)
UNUSED(GetNumberOfEventIndicators)
UNUSED(GetNumberOfContinuousStates)
UNUSED(EnterStepMode)
UNUSED(GetOutputDerivatives)
UNUSED(ActivateModelPartition)
