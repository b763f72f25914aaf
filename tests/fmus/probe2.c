/* A strict FMI 2.0 Co-Simulation FMU for tests.

   dx/dt = u, y = gain u + x + trim, and one feed-through of each other type. A call that the state machine of
   FMI 2.0 does not allow in the present phase is an error. Calls are traced to the file PROBE_TRACE. From
   t = 0.5 s on, doStep returns FAULT (a fmi2Status) if that is defined, or y is NaN with FAULT_NAN; SET_STATUS
   and GET_STATUS are returned by every set of reals and get. HARM is a statement that is executed in the function
   HARM_IN (doStep from t = 0.5 s on): what the FMU does to the process that runs it. */

#include <math.h>
#include <pthread.h>
#include <signal.h>
#include <unistd.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include "fmi2FunctionTypes.h"

#ifndef FAULT
#define FAULT fmi2OK
#endif
#ifndef SET_STATUS
#define SET_STATUS fmi2OK
#endif
#ifndef GET_STATUS
#define GET_STATUS fmi2OK
#endif
#ifndef HARM
#define HARM
#define HARM_IN 0
#endif
enum { NOWHERE, INSTANTIATE, INITIALIZE, SET, GET, STEP, FREE };
#define HARMED(place) do { if (HARM_IN == place) { HARM; } } while (0)
#define EXPORT __attribute__((visibility("default")))

enum { U, GAIN, X, Y, TRIM, REALS };
enum { N_IN, N_OUT, MODE_IN, MODE_OUT, INTEGERS };
enum { ON, OFF, BOOLEANS };
typedef enum { INSTANTIATED, INITIALIZING, STEPPING, TERMINATED, FAILED } Phase;

typedef struct {
    double real[REALS];
    int integer[INTEGERS], boolean[BOOLEANS];
    double time, stop;
    int set_up;
} State;

typedef struct {
    State s;
    Phase phase;
    int saved;
    char name[64];
    fmi2CallbackFunctions calls;
} Probe;

static void trace(const char* what) {
    const char* path = getenv("PROBE_TRACE");
    FILE* file = path && *path ? fopen(path, "a") : NULL;
    if (file) { fprintf(file, "%s\n", what); fclose(file); }
}

static fmi2Status fail(Probe* p, const char* function) {
    static const char* phases[] = {"instantiated", "initializing", "stepping", "terminated", "failed"};
    p->calls.logger(p->calls.componentEnvironment, p->name, fmi2Error, "logStatusError",
                    "%s is not allowed while %s", function, phases[p->phase]);
    trace("ILLEGAL");
    trace(function);
    p->phase = FAILED;
    return fmi2Error;
}

static void defaults(Probe* p) {
    memset(&p->s, 0, sizeof p->s);
    p->s.real[GAIN] = 2;
    p->s.integer[MODE_IN] = p->s.integer[MODE_OUT] = 1;
    p->s.boolean[ON] = 1;
    p->phase = INSTANTIATED;
}

/* What HARM may call. */
__attribute__((unused)) static int deeper(volatile char* p) {
    volatile char space[4096];
    space[0] = *p;
    return deeper(space) + space[0];
}

__attribute__((unused)) static void swell(void) {
    for (;;) {
        char* p = malloc(1 << 24);
        memset(p, 1, 1 << 24);
    }
}

static void outputs(Probe* p) {
    double* r = p->s.real;
    r[Y] = r[GAIN] * r[U] + r[X] + r[TRIM];
#ifdef FAULT_NAN
    if (p->s.time > 0.5 - 1e-9) r[Y] = NAN;
#endif
    p->s.integer[N_OUT] = p->s.integer[N_IN] + 1;
    p->s.integer[MODE_OUT] = p->s.integer[MODE_IN];
    p->s.boolean[OFF] = !p->s.boolean[ON];
}

EXPORT const char* fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }
EXPORT const char* fmi2GetVersion(void) { return "2.0"; }
EXPORT fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t n, const fmi2String names[]) {
    (void)c; (void)on; (void)n; (void)names;
    return fmi2OK;
}

EXPORT fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                                     const fmi2CallbackFunctions* calls, fmi2Boolean visible, fmi2Boolean logging) {
    (void)resources; (void)visible; (void)logging;
    trace("Instantiate");
    HARMED(INSTANTIATE);
#ifdef REFUSE
    calls->logger(calls->componentEnvironment, name, fmi2Error, "logStatusError", "no licence for %s", guid);
    return NULL;
#endif
    if (type != fmi2CoSimulation || strcmp(guid, "{probe}")) return NULL;
    Probe* p = calls->allocateMemory(1, sizeof *p);
    p->calls = *calls;
    snprintf(p->name, sizeof p->name, "%s", name);
    defaults(p);
    return p;
}

EXPORT void fmi2FreeInstance(fmi2Component c) {
    Probe* p = c;
    HARMED(FREE);
    trace(p->saved ? "FreeInstance with saved states" : "FreeInstance");
    p->calls.freeMemory(p);
}

EXPORT fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean defined, fmi2Real tolerance, fmi2Real start,
                                      fmi2Boolean stop_defined, fmi2Real stop) {
    Probe* p = c;
    (void)defined; (void)tolerance;
    trace("SetupExperiment");
    if (p->phase != INSTANTIATED) return fail(p, "SetupExperiment");
    p->s.set_up = 1;
    p->s.time = start;
    p->s.stop = stop_defined ? stop : INFINITY;
    return fmi2OK;
}

EXPORT fmi2Status fmi2EnterInitializationMode(fmi2Component c) {
    Probe* p = c;
    trace("EnterInitializationMode");
    HARMED(INITIALIZE);
    if (p->phase != INSTANTIATED || !p->s.set_up) return fail(p, "EnterInitializationMode");
    p->phase = INITIALIZING;
    return fmi2OK;
}

EXPORT fmi2Status fmi2ExitInitializationMode(fmi2Component c) {
    Probe* p = c;
    trace("ExitInitializationMode");
    if (p->phase != INITIALIZING) return fail(p, "ExitInitializationMode");
    p->phase = STEPPING;
    return fmi2OK;
}

EXPORT fmi2Status fmi2Terminate(fmi2Component c) {
    Probe* p = c;
    trace("Terminate");
    if (p->phase != STEPPING) return fail(p, "Terminate");
    p->phase = TERMINATED;
    return fmi2OK;
}

EXPORT fmi2Status fmi2Reset(fmi2Component c) {
    trace("Reset");
    defaults(c);
    return fmi2OK;
}

static int settable(Probe* p, int exact, int in_run) {
    return p->phase == STEPPING ? in_run : exact && (p->phase == INSTANTIATED || p->phase == INITIALIZING);
}

EXPORT fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Real values[]) {
    Probe* p = c;
    if (p->s.time > 0.5 - 1e-9) HARMED(SET);
    for (size_t k = 0; k < n; k++) {
        if (!settable(p, vr[k] != Y, vr[k] == U || vr[k] == TRIM)) return fail(p, "SetReal");
        p->s.real[vr[k]] = values[k];
    }
    return SET_STATUS;
}

EXPORT fmi2Status fmi2SetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Integer values[]) {
    Probe* p = c;
    for (size_t k = 0; k < n; k++) {
        int input = vr[k] == N_IN || vr[k] == MODE_IN;
        if (!settable(p, input, input)) return fail(p, "SetInteger");
        p->s.integer[vr[k]] = values[k];
    }
    return fmi2OK;
}

EXPORT fmi2Status fmi2SetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Boolean values[]) {
    Probe* p = c;
    for (size_t k = 0; k < n; k++) {
        if (!settable(p, vr[k] == ON, vr[k] == ON)) return fail(p, "SetBoolean");
        p->s.boolean[vr[k]] = values[k];
    }
    return fmi2OK;
}

#define GET(Name, type, member)                                                                              \
    EXPORT fmi2Status fmi2Get##Name(fmi2Component c, const fmi2ValueReference vr[], size_t n, type values[]) { \
        Probe* p = c;                                                                                        \
        if (p->phase == INSTANTIATED) return fail(p, "Get" #Name);                                           \
        if (p->s.time > 0.5 - 1e-9) HARMED(GET);                                                             \
        outputs(p);                                                                                          \
        for (size_t k = 0; k < n; k++) values[k] = p->s.member[vr[k]];                                       \
        return GET_STATUS;                                                                                   \
    }
GET(Real, fmi2Real, real)
GET(Integer, fmi2Integer, integer)
GET(Boolean, fmi2Boolean, boolean)

EXPORT fmi2Status fmi2DoStep(fmi2Component c, fmi2Real t, fmi2Real h, fmi2Boolean no_set_state) {
    Probe* p = c;
    if (p->phase != STEPPING || fabs(t - p->s.time) > 1e-9 || t + h > p->s.stop + 1e-9) return fail(p, "DoStep");
    if (p->saved && no_set_state) return fail(p, "DoStep without undo");
    if (t + h > 0.5 - 1e-9) HARMED(STEP);
    if (FAULT != fmi2OK && t + h > 0.5 - 1e-9) {
        p->calls.logger(p->calls.componentEnvironment, p->name, FAULT, "logStatusError",
                        "the %s is hot at t = %g s", "bearing", t + h);
        if (FAULT != fmi2Warning) {
            if (FAULT >= fmi2Error) p->phase = FAILED;
            return FAULT;
        }
    }
    p->s.real[X] += h * p->s.real[U];
    p->s.time = t + h;
    return FAULT == fmi2Warning && p->s.time > 0.5 - 1e-9 ? fmi2Warning : fmi2OK;
}

EXPORT fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Boolean* value) {
    (void)c;
    *value = kind == fmi2Terminated;
    return fmi2OK;
}

EXPORT fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate* state) {
    Probe* p = c;
#ifdef REFUSE_STATE
    return fail(p, "GetFMUstate");
#endif
    if (!*state) { *state = malloc(sizeof(State)); p->saved++; }
    memcpy(*state, &p->s, sizeof(State));
    return fmi2OK;
}

EXPORT fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate state) {
    Probe* p = c;
#ifdef REFUSE_RESTORE
    return fail(p, "SetFMUstate");
#endif
    memcpy(&p->s, state, sizeof(State));
    return fmi2OK;
}

EXPORT fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate* state) {
    ((Probe*)c)->saved--;
    free(*state);
    *state = NULL;
    return fmi2OK;
}

/* Functions that FMPy wants to find and nothing calls. */
#define UNUSED(name) EXPORT fmi2Status name(fmi2Component c) { return fail(c, #name); }
UNUSED(fmi2GetString)
UNUSED(fmi2SetString)
UNUSED(fmi2SerializedFMUstateSize)
UNUSED(fmi2SerializeFMUstate)
UNUSED(fmi2DeSerializeFMUstate)
UNUSED(fmi2GetDirectionalDerivative)
UNUSED(fmi2SetRealInputDerivatives)
UNUSED(fmi2GetRealOutputDerivatives)
UNUSED(fmi2CancelStep)
UNUSED(fmi2GetStatus)
UNUSED(fmi2GetRealStatus)
UNUSED(fmi2GetIntegerStatus)
#ifndef LACKING
UNUSED(fmi2GetStringStatus)
#endif
