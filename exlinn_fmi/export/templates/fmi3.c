/* FMI 3.0: Model Exchange and Co-Simulation, each function in terms of instance.c. */
#include "fmi3Functions.h"

typedef struct {
    fmi3InstanceEnvironment environment;
    fmi3LogMessageCallback log;
    fmi3IntermediateUpdateCallback update;
    int early_return; /* whether the importer allows that */
} Importer;

#include "instance.c"

static void tell(const Instance *s, Status status, const char *category, const char *text)
{
    if (s->importer.log) {
        s->importer.log(s->importer.environment, (fmi3Status)status, category, text);
    }
}

/* ── life cycle ─────────────────────────────────────────────────────────────────────────────────────────── */

const char *fmi3GetVersion(void)
{
    return fmi3Version;
}

fmi3Status fmi3SetDebugLogging(fmi3Instance c, fmi3Boolean on, size_t n, const fmi3String categories[])
{
    (void)on, (void)n, (void)categories; /* there is nothing to say beside errors and warnings */
    REQUIRE(c, OUTSIDE_OF_STEPS);
    return fmi3OK;
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                          fmi3Boolean logging, fmi3InstanceEnvironment environment,
                                          fmi3LogMessageCallback log)
{
    const Importer importer = {environment, log, NULL, 0};
    (void)resources, (void)visible, (void)logging; /* no resources, no window; errors and warnings are always told */
    return create(name, token, 0, &importer);
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                         fmi3Boolean logging, fmi3Boolean event_mode, fmi3Boolean early_return,
                                         const fmi3ValueReference intermediate[], size_t n_intermediate,
                                         fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                                         fmi3IntermediateUpdateCallback update)
{
    const Importer importer = {environment, log, update, early_return};
    (void)resources, (void)visible, (void)logging;
    (void)intermediate, (void)n_intermediate; /* all variables can be read between internal steps */
    Instance *s = create(name, token, 1, &importer);
    if (s && event_mode) {
        fail(s, "%s: there is no event mode in Co-Simulation, hasEventMode is false", __func__);
        destroy(s);
        s = NULL;
    }
    return s;
}

fmi3Instance fmi3InstantiateScheduledExecution(fmi3String name, fmi3String token, fmi3String resources,
                                               fmi3Boolean visible, fmi3Boolean logging,
                                               fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                                               fmi3ClockUpdateCallback clock_update,
                                               fmi3LockPreemptionCallback lock, fmi3UnlockPreemptionCallback unlock)
{
    (void)name, (void)token, (void)resources, (void)visible, (void)logging, (void)clock_update, (void)lock, (void)unlock;
    if (log) {
        log(environment, fmi3Error, "logStatusError", "this FMU is not made for Scheduled Execution");
    }
    return NULL;
}

void fmi3FreeInstance(fmi3Instance c)
{
    destroy(c);
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean tolerance_defined, fmi3Float64 tolerance,
                                       fmi3Float64 start_time, fmi3Boolean stop_time_defined, fmi3Float64 stop_time)
{
    Instance *s = c;
    (void)tolerance_defined, (void)tolerance; /* how it integrates is for its parameters to say */
    REQUIRE(s, INSTANTIATED);
    const Status status = set_experiment(s, start_time, stop_time_defined, stop_time);
    if (status == OK) {
        enter_initialization(s);
    }
    return status;
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance c)
{
    REQUIRE(c, INITIALIZATION);
    return start(c);
}

fmi3Status fmi3EnterEventMode(fmi3Instance c)
{
    Instance *s = c;
    REQUIRE(s, CONTINUOUS_TIME);
    s->state.mode = EVENT;
    return fmi3OK;
}

fmi3Status fmi3Terminate(fmi3Instance c)
{
    Instance *s = c;
    REQUIRE(s, RUNNING);
    s->state.mode = TERMINATED;
    return fmi3OK;
}

fmi3Status fmi3Reset(fmi3Instance c)
{
    Instance *s = c;
    REQUIRE(s, OUTSIDE_OF_STEPS);
    begin(&s->state);
    return fmi3OK;
}

/* ── values ─────────────────────────────────────────────────────────────────────────────────────────────── */

fmi3Status fmi3GetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3Float64 value[], size_t n_values)
{
    REQUIRE_ARRAY(c, vr && value, n);
    return c ? get_reals(c, __func__, vr, n, value, n_values) : FAILED;
}

fmi3Status fmi3SetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3Float64 value[],
                          size_t n_values)
{
    REQUIRE_ARRAY(c, vr && value, n);
    return c ? set_reals(c, __func__, vr, n, value, n_values) : FAILED;
}

fmi3Status fmi3GetBoolean(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3Boolean value[], size_t n_values)
{
    REQUIRE_ARRAY(c, vr && value && n_values >= n, n);
    for (size_t k = 0; k < n; k++) {
        int found;
        if (!c || get_boolean(c, __func__, vr[k], &found) != OK) {
            return fmi3Error;
        }
        value[k] = found;
    }
    return fmi3OK;
}

fmi3Status fmi3SetBoolean(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3Boolean value[],
                          size_t n_values)
{
    REQUIRE_ARRAY(c, vr && value && n_values >= n, n);
    for (size_t k = 0; k < n; k++) {
        if (!c || set_boolean(c, __func__, vr[k], value[k]) != OK) {
            return fmi3Error;
        }
    }
    return fmi3OK;
}

/* There are no variables of other types: asking for nothing is no mistake. */
#define NO_VARIABLES(TYPE) \
    fmi3Status fmi3Get##TYPE(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3##TYPE value[], \
                             size_t n_values) \
    { \
        (void)vr, (void)value, (void)n_values; \
        return n ? fail(c, "%s: this model has no variables of type " #TYPE, __func__) : fmi3OK; \
    } \
    fmi3Status fmi3Set##TYPE(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3##TYPE value[], \
                             size_t n_values) \
    { \
        (void)vr, (void)value, (void)n_values; \
        return n ? fail(c, "%s: this model has no variables of type " #TYPE, __func__) : fmi3OK; \
    }

NO_VARIABLES(Float32)
NO_VARIABLES(Int8)
NO_VARIABLES(UInt8)
NO_VARIABLES(Int16)
NO_VARIABLES(UInt16)
NO_VARIABLES(Int32)
NO_VARIABLES(UInt32)
NO_VARIABLES(Int64)
NO_VARIABLES(UInt64)
NO_VARIABLES(String)

#define NONE(n, what) \
    return (n) ? fail(c, "%s: this model has no " what, __func__) : fmi3OK

fmi3Status fmi3GetBinary(fmi3Instance c, const fmi3ValueReference vr[], size_t n, size_t sizes[], fmi3Binary value[],
                         size_t n_values)
{
    (void)vr, (void)sizes, (void)value, (void)n_values;
    NONE(n, "variables of type Binary");
}

fmi3Status fmi3SetBinary(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const size_t sizes[],
                         const fmi3Binary value[], size_t n_values)
{
    (void)vr, (void)sizes, (void)value, (void)n_values;
    NONE(n, "variables of type Binary");
}

fmi3Status fmi3GetClock(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3Clock value[])
{
    (void)vr, (void)value;
    NONE(n, "clocks");
}

fmi3Status fmi3SetClock(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3Clock value[])
{
    (void)vr, (void)value;
    NONE(n, "clocks");
}

fmi3Status fmi3GetIntervalDecimal(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3Float64 interval[],
                                  fmi3IntervalQualifier qualifier[])
{
    (void)vr, (void)interval, (void)qualifier;
    NONE(n, "clocks");
}

fmi3Status fmi3GetIntervalFraction(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3UInt64 counter[],
                                   fmi3UInt64 resolution[], fmi3IntervalQualifier qualifier[])
{
    (void)vr, (void)counter, (void)resolution, (void)qualifier;
    NONE(n, "clocks");
}

fmi3Status fmi3GetShiftDecimal(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3Float64 shift[])
{
    (void)vr, (void)shift;
    NONE(n, "clocks");
}

fmi3Status fmi3GetShiftFraction(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3UInt64 counter[],
                                fmi3UInt64 resolution[])
{
    (void)vr, (void)counter, (void)resolution;
    NONE(n, "clocks");
}

fmi3Status fmi3SetIntervalDecimal(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                                  const fmi3Float64 interval[])
{
    (void)vr, (void)interval;
    NONE(n, "clocks");
}

fmi3Status fmi3SetIntervalFraction(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3UInt64 counter[],
                                   const fmi3UInt64 resolution[])
{
    (void)vr, (void)counter, (void)resolution;
    NONE(n, "clocks");
}

fmi3Status fmi3SetShiftDecimal(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3Float64 shift[])
{
    (void)vr, (void)shift;
    NONE(n, "clocks");
}

fmi3Status fmi3SetShiftFraction(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3UInt64 counter[],
                                const fmi3UInt64 resolution[])
{
    (void)vr, (void)counter, (void)resolution;
    NONE(n, "clocks");
}

fmi3Status fmi3ActivateModelPartition(fmi3Instance c, fmi3ValueReference clock, fmi3Float64 time)
{
    (void)clock, (void)time;
    NONE(1, "clocks");
}

fmi3Status fmi3GetNumberOfVariableDependencies(fmi3Instance c, fmi3ValueReference vr, size_t *n)
{
    (void)vr, (void)n;
    return fail(c, "%s: providesPerElementDependencies is false", __func__);
}

fmi3Status fmi3GetVariableDependencies(fmi3Instance c, fmi3ValueReference dependent, size_t elements[],
                                       fmi3ValueReference independents[], size_t independent_elements[],
                                       fmi3DependencyKind kinds[], size_t n)
{
    (void)dependent, (void)elements, (void)independents, (void)independent_elements, (void)kinds, (void)n;
    return fail(c, "%s: providesPerElementDependencies is false", __func__);
}

/* No dimension depends on a parameter: there is nothing to configure. */
fmi3Status fmi3EnterConfigurationMode(fmi3Instance c)
{
    return fail(c, "%s: this model has no structural parameters", __func__);
}

fmi3Status fmi3ExitConfigurationMode(fmi3Instance c)
{
    return fail(c, "%s: this model has no structural parameters", __func__);
}

/* ── FMU state ──────────────────────────────────────────────────────────────────────────────────────────── */

fmi3Status fmi3GetFMUState(fmi3Instance c, fmi3FMUState *copy)
{
    REQUIRE(c, OUTSIDE_OF_STEPS);
    return get_state(c, copy);
}

fmi3Status fmi3SetFMUState(fmi3Instance c, fmi3FMUState copy)
{
    REQUIRE(c, OUTSIDE_OF_STEPS);
    return set_state(c, copy);
}

fmi3Status fmi3FreeFMUState(fmi3Instance c, fmi3FMUState *copy)
{
    (void)c;
    return free_state(copy);
}

fmi3Status fmi3SerializedFMUStateSize(fmi3Instance c, fmi3FMUState copy, size_t *size)
{
    (void)copy;
    REQUIRE_ARRAY(c, size, 1);
    *size = SERIALIZED_SIZE;
    return fmi3OK;
}

fmi3Status fmi3SerializeFMUState(fmi3Instance c, fmi3FMUState copy, fmi3Byte bytes[], size_t size)
{
    return serialize(c, copy, bytes, size);
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance c, const fmi3Byte bytes[], size_t size, fmi3FMUState *copy)
{
    REQUIRE(c, OUTSIDE_OF_STEPS);
    return deserialize(c, bytes, size, copy);
}

/* ── derivatives ────────────────────────────────────────────────────────────────────────────────────────── */

fmi3Status fmi3GetDirectionalDerivative(fmi3Instance c, const fmi3ValueReference unknown[], size_t n_unknown,
                                        const fmi3ValueReference known[], size_t n_known, const fmi3Float64 seed[],
                                        size_t n_seed, fmi3Float64 result[], size_t n_result)
{
    REQUIRE(c, INITIALIZATION | RUNNING | INTERMEDIATE);
    REQUIRE_ARRAY(c, unknown && result, n_unknown);
    REQUIRE_ARRAY(c, known && seed, n_known);
    return directional(c, __func__, unknown, n_unknown, known, n_known, seed, n_seed, result, n_result);
}

fmi3Status fmi3GetAdjointDerivative(fmi3Instance c, const fmi3ValueReference unknown[], size_t n_unknown,
                                    const fmi3ValueReference known[], size_t n_known, const fmi3Float64 seed[],
                                    size_t n_seed, fmi3Float64 result[], size_t n_result)
{
    REQUIRE(c, INITIALIZATION | RUNNING | INTERMEDIATE);
    REQUIRE_ARRAY(c, unknown && seed, n_unknown);
    REQUIRE_ARRAY(c, known && result, n_known);
    return adjoint_derivative(c, __func__, unknown, n_unknown, known, n_known, seed, n_seed, result, n_result);
}

/* ── Model Exchange: the importer integrates ────────────────────────────────────────────────────────────── */

fmi3Status fmi3EvaluateDiscreteStates(fmi3Instance c)
{
    return fail(c, "%s: providesEvaluateDiscreteStates is false", __func__);
}

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance c, fmi3Boolean *again, fmi3Boolean *terminate,
                                    fmi3Boolean *nominals_changed, fmi3Boolean *states_changed,
                                    fmi3Boolean *next_event_defined, fmi3Float64 *next_event)
{
    REQUIRE(c, EVENT);
    REQUIRE_ARRAY(c, again && terminate && nominals_changed && states_changed && next_event_defined && next_event, 1);
    *again = *terminate = *nominals_changed = *states_changed = *next_event_defined = fmi3False;
    *next_event = 0.0;
    mind_range(c);
    return fmi3OK;
}

fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance c)
{
    Instance *s = c;
    REQUIRE(s, EVENT);
    s->state.mode = CONTINUOUS_TIME;
    return fmi3OK;
}

fmi3Status fmi3CompletedIntegratorStep(fmi3Instance c, fmi3Boolean no_set_state_prior, fmi3Boolean *enter_event_mode,
                                       fmi3Boolean *terminate)
{
    (void)no_set_state_prior;
    REQUIRE(c, CONTINUOUS_TIME);
    REQUIRE_ARRAY(c, enter_event_mode && terminate, 1);
    *enter_event_mode = fmi3False;
    *terminate = fmi3False;
    return fmi3OK;
}

fmi3Status fmi3SetTime(fmi3Instance c, fmi3Float64 time)
{
    REQUIRE(c, EVENT | CONTINUOUS_TIME);
    return set_time(c, __func__, time);
}

fmi3Status fmi3SetContinuousStates(fmi3Instance c, const fmi3Float64 x[], size_t n)
{
    REQUIRE(c, CONTINUOUS_TIME);
    return set_states(c, __func__, x, n);
}

fmi3Status fmi3GetContinuousStates(fmi3Instance c, fmi3Float64 x[], size_t n)
{
    REQUIRE(c, OUTSIDE_OF_STEPS);
    return get_states(c, __func__, x, n);
}

fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance c, fmi3Float64 dx[], size_t n)
{
    REQUIRE(c, INITIALIZATION | EVENT | CONTINUOUS_TIME);
    return get_derivatives(c, __func__, dx, n);
}

fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance c, fmi3Float64 nominal[], size_t n)
{
    REQUIRE(c, OUTSIDE_OF_STEPS);
    return get_nominals(c, __func__, nominal, n);
}

fmi3Status fmi3GetEventIndicators(fmi3Instance c, fmi3Float64 indicators[], size_t n)
{
    REQUIRE(c, INITIALIZATION | EVENT | CONTINUOUS_TIME);
    return get_indicators(c, __func__, indicators, n);
}

fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance c, size_t *n)
{
    REQUIRE_ARRAY(c, n, 1);
    *n = RANGED;
    return fmi3OK;
}

fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance c, size_t *n)
{
    REQUIRE_ARRAY(c, n, 1);
    *n = NX;
    return fmi3OK;
}

/* ── Co-Simulation: the model integrates itself ─────────────────────────────────────────────────────────── */

fmi3Status fmi3EnterStepMode(fmi3Instance c)
{
    return fail(c, "%s: there is no event mode in Co-Simulation, hasEventMode is false", __func__);
}

/* After each internal step the importer may look, set inputs, and ask to end early. */
static void intermediate_update(void *instance, double since, double *end)
{
    Instance *s = instance;
    fmi3Boolean early = fmi3False;
    const double now = s->state.values[TIME];
    double until = now;

    s->state.mode = INTERMEDIATE;
    s->importer.update(s->importer.environment, now, fmi3True, fmi3True, fmi3True, s->importer.early_return != 0,
                       &early, &until);
    s->state.mode = STEP;
    if (early && s->importer.early_return && isfinite(until)) {
        const double wanted = since + (until > now ? until - now : 0.0);
        *end = wanted < *end ? wanted : *end;
    }
}

fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 t, fmi3Float64 h, fmi3Boolean no_set_state_prior,
                      fmi3Boolean *event_needed, fmi3Boolean *terminate, fmi3Boolean *early, fmi3Float64 *last_time)
{
    Instance *s = c;
    double end = h;
    (void)no_set_state_prior;
    REQUIRE(s, STEP);
    REQUIRE_ARRAY(s, event_needed && terminate && early && last_time, 1);
    const Status status = step(s, __func__, t, h, &end, s->importer.update ? intermediate_update : NULL);
    *event_needed = fmi3False;
    *terminate = fmi3False;
    *early = status == OK && end < h;
    *last_time = s->state.values[TIME];
    return status;
}

fmi3Status fmi3GetOutputDerivatives(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3Int32 order[],
                                    fmi3Float64 value[], size_t n_values)
{
    REQUIRE(c, STEP | INTERMEDIATE);
    REQUIRE_ARRAY(c, vr && order && value, n);
    return output_derivatives(c, __func__, vr, n, order, value, n_values);
}
