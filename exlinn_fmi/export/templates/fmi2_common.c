/* FMI 2.0, the part that Model Exchange and Co-Simulation share: life cycle, values, FMU state, derivatives. */
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>

#include "fmi2Functions.h"

/* The modes of FMI 2.0's state machines, as bits so that a set of them is one number. */
enum {
    INSTANTIATED = 1,
    INITIALIZATION = 2,
    STEP = 4,
    EVENT = 8,
    CONTINUOUS_TIME = 16,
    TERMINATED = 32
};
enum { BEFORE_START = INSTANTIATED | INITIALIZATION, RUNNING = STEP | EVENT | CONTINUOUS_TIME };

typedef struct {
    State state;
    fmi2Type type;
    fmi2CallbackFunctions importer;
    char name[]; /* C99: as long as it was allocated */
} Instance;

static const char *mode_name(int mode)
{
    switch (mode) {
    case INSTANTIATED: return "instantiated";
    case INITIALIZATION: return "initialization";
    case STEP: return "step complete";
    case EVENT: return "event";
    case CONTINUOUS_TIME: return "continuous time";
    default: return "terminated";
    }
}

/* Tells the importer what went wrong, in printf's manner, and gives fmi2Error to return. */
static fmi2Status fail(const Instance *s, const char *format, ...)
{
    char text[512];
    va_list arguments;

    va_start(arguments, format);
    vsnprintf(text, sizeof text, format, arguments);
    va_end(arguments);
    for (char *c = text; *c; c++) {
        if (*c == '%') { /* the importer may read the text as a format again */
            *c = '?';
        }
    }
    if (s->importer.logger) {
        s->importer.logger(s->importer.componentEnvironment, s->name, fmi2Error, "logStatusError", text);
    }
    return fmi2Error;
}

/* Whether the instance is in one of the modes in which a function may be called. */
static int allowed(const Instance *s, int modes, const char *function)
{
    if (s->state.mode & modes) {
        return 1;
    }
    fail(s, "%s may not be called in mode '%s' of this %s instance", function, mode_name(s->state.mode),
         s->type == fmi2CoSimulation ? "Co-Simulation" : "Model Exchange");
    return 0;
}

#define REQUIRE(s, modes) \
    do { \
        if (!allowed((s), (modes), __func__)) { \
            return fmi2Error; \
        } \
    } while (0)

static void begin(State *s)
{
    memset(s, 0, sizeof *s);
    memcpy(s->values, START, sizeof START);
    s->stop_time = INFINITY;
    s->mode = INSTANTIATED;
}

/* ── life cycle ─────────────────────────────────────────────────────────────────────────────────────────── */

const char *fmi2GetTypesPlatform(void)
{
    return fmi2TypesPlatform;
}

const char *fmi2GetVersion(void)
{
    return fmi2Version;
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *importer, fmi2Boolean visible, fmi2Boolean logging)
{
    (void)resources, (void)visible, (void)logging; /* no resources, no window; errors are always reported */
    name = name ? name : "";
    Instance *s = importer ? calloc(1, sizeof *s + strlen(name) + 1) : NULL;
    if (!s) {
        return NULL;
    }
    s->type = type;
    s->importer = *importer;
    strcpy(s->name, name);
    begin(&s->state);
    if (!guid || strcmp(guid, MODEL_TOKEN)) {
        fail(s, "the guid is %s, expected %s: modelDescription.xml and binary are not of one build of "
             MODEL_IDENTIFIER, guid ? guid : "missing", MODEL_TOKEN);
        free(s);
        return NULL;
    }
    return s;
}

void fmi2FreeInstance(fmi2Component c)
{
    free(c);
}

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t n, const fmi2String categories[])
{
    (void)c, (void)on, (void)n, (void)categories; /* there is nothing to say beside errors */
    return fmi2OK;
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean tolerance_defined, fmi2Real tolerance,
                               fmi2Real start_time, fmi2Boolean stop_time_defined, fmi2Real stop_time)
{
    Instance *s = c;
    (void)tolerance_defined, (void)tolerance; /* the step is fixed: parameter solver_step */
    REQUIRE(s, INSTANTIATED);
    if (!isfinite(start_time) || (stop_time_defined && !(stop_time >= start_time))) {
        return fail(s, "%s: the start time is %g s, the stop time %g s", __func__, start_time, stop_time);
    }
    s->state.time = start_time;
    s->state.stop_time = stop_time_defined ? stop_time : INFINITY;
    return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c)
{
    Instance *s = c;
    REQUIRE(s, INSTANTIATED);
    s->state.mode = INITIALIZATION;
    return fmi2OK;
}

fmi2Status fmi2ExitInitializationMode(fmi2Component c)
{
    Instance *s = c;
    REQUIRE(s, INITIALIZATION);
    refresh(&s->state);
    const int bad = first_not_finite(s->state.values, FIRST_DX, NX);
    if (bad >= 0) {
        return fail(s, "%s is %g at the start; check the parameters and the initial state", NAMES[bad],
                    s->state.values[bad]);
    }
    s->state.mode = s->type == fmi2CoSimulation ? STEP : EVENT;
    return fmi2OK;
}

fmi2Status fmi2Terminate(fmi2Component c)
{
    Instance *s = c;
    REQUIRE(s, RUNNING);
    s->state.mode = TERMINATED;
    return fmi2OK;
}

fmi2Status fmi2Reset(fmi2Component c)
{
    Instance *s = c;
    begin(&s->state);
    return fmi2OK;
}

/* ── values ─────────────────────────────────────────────────────────────────────────────────────────────── */

static fmi2Status unknown_reference(const Instance *s, const char *function, fmi2ValueReference r)
{
    return fail(s, "%s: there is no value reference %u, the last one is %d", function, r, N_VALUES - 1);
}

/* The modes in which a value may be set: solver_step and, where the model integrates itself, states before the start,
 * inputs and parameters also later on, derivatives and outputs never. This is wider than the standard for Model
 * Exchange, because CasADi, which reads FMUs as functions, sets states and parameters in continuous-time mode. */
static int settable(fmi2ValueReference r)
{
    if (r < FIRST_U) {
        return BEFORE_START | EVENT | CONTINUOUS_TIME;
    }
    if (r < N_KNOWN) {
        return BEFORE_START | RUNNING;
    }
    return r == SOLVER_STEP ? BEFORE_START : 0;
}

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Real value[])
{
    Instance *s = c;
    fmi2Status status = fmi2OK;

    for (size_t k = 0; k < n; k++) {
        if (vr[k] >= N_VALUES) {
            return unknown_reference(s, __func__, vr[k]);
        }
        if (vr[k] >= FIRST_DX) {
            refresh(&s->state);
        }
        value[k] = s->state.values[vr[k]];
        if (!isfinite(value[k])) {
            status = fail(s, "%s is %g at t = %.9g s", NAMES[vr[k]], value[k], s->state.time);
        }
    }
    return status;
}

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Real value[])
{
    Instance *s = c;

    for (size_t k = 0; k < n; k++) { /* all is checked before anything is set */
        if (vr[k] >= N_VALUES) {
            return unknown_reference(s, __func__, vr[k]);
        }
        if (!(s->state.mode & settable(vr[k]))) {
            return fail(s, "%s may not be set in mode '%s'", NAMES[vr[k]], mode_name(s->state.mode));
        }
        if (!isfinite(value[k])) {
            return fail(s, "%s was set to %g at t = %.9g s, expected a finite number", NAMES[vr[k]], value[k],
                        s->state.time);
        }
        if (vr[k] == SOLVER_STEP && value[k] <= 0.0) {
            return fail(s, "%s was set to %g s, expected a positive number", NAMES[vr[k]], value[k]);
        }
    }
    for (size_t k = 0; k < n; k++) {
        s->state.values[vr[k]] = value[k];
    }
    s->state.fresh = 0;
    return fmi2OK;
}

/* All variables are real: there is nothing else to get or set, and asking for nothing is no mistake. */
#define NO_VARIABLES(TYPE) \
    fmi2Status fmi2Get##TYPE(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2##TYPE value[]) \
    { \
        (void)vr, (void)value; \
        return n ? fail(c, "%s: all variables of this model are of type Real", __func__) : fmi2OK; \
    } \
    fmi2Status fmi2Set##TYPE(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2##TYPE value[]) \
    { \
        (void)vr, (void)value; \
        return n ? fail(c, "%s: all variables of this model are of type Real", __func__) : fmi2OK; \
    }

NO_VARIABLES(Integer)
NO_VARIABLES(Boolean)
NO_VARIABLES(String)

/* ── FMU state ──────────────────────────────────────────────────────────────────────────────────────────── */

/* A serialised state begins with the token of the model, so that one of another model is refused. */
enum { TOKEN_SIZE = sizeof MODEL_TOKEN, SERIALIZED_SIZE = TOKEN_SIZE + sizeof(State) };

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *copy)
{
    Instance *s = c;
    if (!*copy) {
        *copy = malloc(sizeof(State));
    }
    if (!*copy) {
        return fail(s, "%s: out of memory", __func__);
    }
    memcpy(*copy, &s->state, sizeof(State));
    return fmi2OK;
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate copy)
{
    Instance *s = c;
    memcpy(&s->state, copy, sizeof(State));
    return fmi2OK;
}

fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *copy)
{
    (void)c;
    if (copy) {
        free(*copy);
        *copy = NULL;
    }
    return fmi2OK;
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate copy, size_t *size)
{
    (void)c, (void)copy;
    *size = SERIALIZED_SIZE;
    return fmi2OK;
}

fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate copy, fmi2Byte bytes[], size_t size)
{
    if (size < SERIALIZED_SIZE) {
        return fail(c, "%s: room for %u bytes, needed are %d", __func__, (unsigned)size, (int)SERIALIZED_SIZE);
    }
    memcpy(bytes, MODEL_TOKEN, TOKEN_SIZE);
    memcpy(bytes + TOKEN_SIZE, copy, sizeof(State));
    return fmi2OK;
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size, fmi2FMUstate *copy)
{
    Instance *s = c;
    if (size < SERIALIZED_SIZE || memcmp(bytes, MODEL_TOKEN, TOKEN_SIZE)) {
        return fail(s, "%s: these bytes are not a state of this build of " MODEL_IDENTIFIER, __func__);
    }
    const fmi2Status status = fmi2GetFMUstate(c, copy);
    if (status == fmi2OK) {
        memcpy(*copy, bytes + TOKEN_SIZE, sizeof(State));
    }
    return status;
}

/* ── derivatives ────────────────────────────────────────────────────────────────────────────────────────── */

fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference unknown[], size_t n_unknown,
                                        const fmi2ValueReference known[], size_t n_known,
                                        const fmi2Real direction[], fmi2Real result[])
{
    Instance *s = c;
    double seed[N_KNOWN] = {0}, tangent[NX + NY];

    REQUIRE(s, INITIALIZATION | RUNNING);
    for (size_t k = 0; k < n_known; k++) {
        if (known[k] >= N_KNOWN) {
            return fail(s, "%s: value reference %u is no state, input or parameter", __func__, known[k]);
        }
        seed[known[k]] = direction[k];
    }
    call(MODEL_FUNCTION(tangent), s->state.values, seed, tangent);
    for (size_t k = 0; k < n_unknown; k++) {
        if (unknown[k] >= N_VALUES || (unknown[k] >= FIRST_U && unknown[k] < FIRST_DX)) {
            return fail(s, "%s: value reference %u is no derivative or output", __func__, unknown[k]);
        }
        result[k] = unknown[k] < FIRST_U ? seed[unknown[k]] : tangent[unknown[k] - FIRST_DX];
        if (!isfinite(result[k])) {
            return fail(s, "the directional derivative of %s is %g at t = %.9g s", NAMES[unknown[k]], result[k],
                        s->state.time);
        }
    }
    return fmi2OK;
}
