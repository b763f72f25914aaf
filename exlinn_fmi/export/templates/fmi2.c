/* FMI 2.0: Model Exchange and Co-Simulation, each function in terms of instance.c. */
#include "fmi2Functions.h"

typedef fmi2CallbackFunctions Importer;

#include "instance.c"

static void tell(const Instance *s, Status status, const char *category, const char *text)
{
    if (s->importer.logger) {
        s->importer.logger(s->importer.componentEnvironment, s->name, (fmi2Status)status, category, text);
    }
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
    (void)resources, (void)visible, (void)logging; /* no resources, no window; errors and warnings are always told */
    return importer ? create(name, guid, type == fmi2CoSimulation, importer) : NULL;
}

void fmi2FreeInstance(fmi2Component c)
{
    destroy(c);
}

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t n, const fmi2String categories[])
{
    (void)on, (void)n, (void)categories; /* there is nothing to say beside errors and warnings */
    REQUIRE(c, OUTSIDE_OF_STEPS);
    return fmi2OK;
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean tolerance_defined, fmi2Real tolerance,
                               fmi2Real start_time, fmi2Boolean stop_time_defined, fmi2Real stop_time)
{
    (void)tolerance_defined, (void)tolerance; /* how it integrates is for its parameters to say */
    REQUIRE(c, INSTANTIATED);
    return set_experiment(c, start_time, stop_time_defined, stop_time);
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c)
{
    Instance *s = c;
    REQUIRE(s, INSTANTIATED);
    enter_initialization(s);
    return fmi2OK;
}

fmi2Status fmi2ExitInitializationMode(fmi2Component c)
{
    REQUIRE(c, INITIALIZATION);
    return start(c);
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
    REQUIRE(s, OUTSIDE_OF_STEPS);
    begin(&s->state);
    return fmi2OK;
}

/* ── values ─────────────────────────────────────────────────────────────────────────────────────────────── */

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Real value[])
{
    REQUIRE(c, OUTSIDE_OF_STEPS);
    REQUIRE_ARRAY(c, vr && value, n);
    return get_reals(c, __func__, vr, n, value, (size_t)-1);
}

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Real value[])
{
    REQUIRE(c, OUTSIDE_OF_STEPS);
    REQUIRE_ARRAY(c, vr && value, n);
    return set_reals(c, __func__, vr, n, value, (size_t)-1);
}

fmi2Status fmi2GetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Boolean value[])
{
    REQUIRE(c, OUTSIDE_OF_STEPS);
    REQUIRE_ARRAY(c, vr && value, n);
    for (size_t k = 0; k < n; k++) {
        if (get_boolean(c, __func__, vr[k], &value[k]) != OK) {
            return fmi2Error;
        }
    }
    return fmi2OK;
}

fmi2Status fmi2SetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Boolean value[])
{
    REQUIRE(c, OUTSIDE_OF_STEPS);
    REQUIRE_ARRAY(c, vr && value, n);
    for (size_t k = 0; k < n; k++) {
        if (set_boolean(c, __func__, vr[k], value[k]) != OK) {
            return fmi2Error;
        }
    }
    return fmi2OK;
}

/* There are no variables of other types: asking for nothing is no mistake. */
#define NO_VARIABLES(TYPE) \
    fmi2Status fmi2Get##TYPE(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2##TYPE value[]) \
    { \
        (void)vr, (void)value; \
        return n ? fail(c, "%s: this model has no variables of type " #TYPE, __func__) : fmi2OK; \
    } \
    fmi2Status fmi2Set##TYPE(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2##TYPE value[]) \
    { \
        (void)vr, (void)value; \
        return n ? fail(c, "%s: this model has no variables of type " #TYPE, __func__) : fmi2OK; \
    }

NO_VARIABLES(Integer)
NO_VARIABLES(String)

/* ── FMU state ──────────────────────────────────────────────────────────────────────────────────────────── */

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *copy)
{
    REQUIRE(c, OUTSIDE_OF_STEPS);
    return get_state(c, copy);
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate copy)
{
    REQUIRE(c, OUTSIDE_OF_STEPS);
    return set_state(c, copy);
}

fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *copy)
{
    (void)c;
    return free_state(copy);
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate copy, size_t *size)
{
    (void)copy;
    REQUIRE_ARRAY(c, size, 1);
    *size = SERIALIZED_SIZE;
    return fmi2OK;
}

fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate copy, fmi2Byte bytes[], size_t size)
{
    return serialize(c, copy, bytes, size);
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size, fmi2FMUstate *copy)
{
    REQUIRE(c, OUTSIDE_OF_STEPS);
    return deserialize(c, bytes, size, copy);
}

/* ── derivatives ────────────────────────────────────────────────────────────────────────────────────────── */

fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference unknown[], size_t n_unknown,
                                        const fmi2ValueReference known[], size_t n_known,
                                        const fmi2Real direction[], fmi2Real result[])
{
    REQUIRE(c, INITIALIZATION | RUNNING);
    REQUIRE_ARRAY(c, unknown && result, n_unknown);
    REQUIRE_ARRAY(c, known && direction, n_known);
    return directional(c, __func__, unknown, n_unknown, known, n_known, direction, (size_t)-1, result, (size_t)-1);
}

/* ── Model Exchange: the importer integrates ────────────────────────────────────────────────────────────── */

fmi2Status fmi2EnterEventMode(fmi2Component c)
{
    Instance *s = c;
    REQUIRE(s, CONTINUOUS_TIME);
    s->state.mode = EVENT;
    return fmi2OK;
}

fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *info)
{
    REQUIRE(c, EVENT);
    REQUIRE_ARRAY(c, info, 1);
    memset(info, 0, sizeof *info);
    mind_range(c);
    return fmi2OK;
}

fmi2Status fmi2EnterContinuousTimeMode(fmi2Component c)
{
    Instance *s = c;
    REQUIRE(s, EVENT);
    s->state.mode = CONTINUOUS_TIME;
    return fmi2OK;
}

fmi2Status fmi2CompletedIntegratorStep(fmi2Component c, fmi2Boolean no_set_state_prior, fmi2Boolean *enter_event_mode,
                                       fmi2Boolean *terminate)
{
    (void)no_set_state_prior;
    REQUIRE(c, CONTINUOUS_TIME);
    REQUIRE_ARRAY(c, enter_event_mode && terminate, 1);
    *enter_event_mode = fmi2False;
    *terminate = fmi2False;
    return fmi2OK;
}

fmi2Status fmi2SetTime(fmi2Component c, fmi2Real time)
{
    REQUIRE(c, EVENT | CONTINUOUS_TIME);
    return set_time(c, __func__, time);
}

fmi2Status fmi2SetContinuousStates(fmi2Component c, const fmi2Real x[], size_t n)
{
    REQUIRE(c, CONTINUOUS_TIME);
    return set_states(c, __func__, x, n);
}

fmi2Status fmi2GetContinuousStates(fmi2Component c, fmi2Real x[], size_t n)
{
    REQUIRE(c, OUTSIDE_OF_STEPS);
    return get_states(c, __func__, x, n);
}

fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real dx[], size_t n)
{
    REQUIRE(c, INITIALIZATION | EVENT | CONTINUOUS_TIME);
    return get_derivatives(c, __func__, dx, n);
}

fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component c, fmi2Real nominal[], size_t n)
{
    REQUIRE(c, OUTSIDE_OF_STEPS);
    return get_nominals(c, __func__, nominal, n);
}

fmi2Status fmi2GetEventIndicators(fmi2Component c, fmi2Real indicators[], size_t n)
{
    REQUIRE(c, INITIALIZATION | EVENT | CONTINUOUS_TIME);
    return get_indicators(c, __func__, indicators, n);
}

/* ── Co-Simulation: the model integrates itself ─────────────────────────────────────────────────────────── */

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real t, fmi2Real h, fmi2Boolean no_set_state_prior)
{
    double end;
    (void)no_set_state_prior;
    REQUIRE(c, STEP);
    return step(c, __func__, t, h, &end, NULL);
}

fmi2Status fmi2CancelStep(fmi2Component c)
{
    return fail(c, "%s: steps are never pending", __func__);
}

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                                       const fmi2Integer order[], const fmi2Real value[])
{
    Instance *s = c;
    REQUIRE(s, BEFORE_START | STEP);
    REQUIRE_ARRAY(s, vr && order && value, n);
    for (size_t k = 0; k < n; k++) {
        if (vr[k] < FIRST_U || vr[k] >= FIRST_P) {
            return fail(s, "%s: value reference %u is no input", __func__, vr[k]);
        }
        if (order[k] < 1 || order[k] > SMOOTHNESS) {
            return fail(s, "%s: derivatives of order 1 to %d can be followed, %d was given", __func__, SMOOTHNESS,
                        order[k]);
        }
        if (!isfinite(value[k])) {
            return fail(s, "%s: the derivative of %s was set to %g", __func__, NAMES[vr[k]], value[k]);
        }
    }
#if !CONTROLLER
    for (size_t k = 0; k < n; k++) {
        s->state.slopes[order[k] - 1][vr[k] - FIRST_U] = value[k];
        s->state.moving = 1;
    }
#endif
    return fmi2OK;
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                                        const fmi2Integer order[], fmi2Real value[])
{
    REQUIRE(c, STEP);
    REQUIRE_ARRAY(c, vr && order && value, n);
    return output_derivatives(c, __func__, vr, n, order, value, (size_t)-1);
}

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value)
{
    const Instance *s = c;
    REQUIRE_ARRAY(s, value, 1);
    if (!s || kind != fmi2LastSuccessfulTime) {
        return fmi2Discard;
    }
    *value = s->state.values[TIME];
    return fmi2OK;
}

fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Boolean *value)
{
    REQUIRE_ARRAY(c, value, 1);
    if (kind != fmi2Terminated) {
        return fmi2Discard;
    }
    *value = fmi2False;
    return fmi2OK;
}

fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Status *value)
{
    (void)c, (void)kind, (void)value;
    return fmi2Discard; /* no step is ever pending */
}

fmi2Status fmi2GetIntegerStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Integer *value)
{
    (void)c, (void)kind, (void)value;
    return fmi2Discard;
}

fmi2Status fmi2GetStringStatus(fmi2Component c, const fmi2StatusKind kind, fmi2String *value)
{
    (void)c, (void)kind, (void)value;
    return fmi2Discard;
}
