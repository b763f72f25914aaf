/* FMI 2.0 for Model Exchange: the importer integrates. The model has no events. */

fmi2Status fmi2EnterEventMode(fmi2Component c)
{
    Instance *s = c;
    REQUIRE(s, CONTINUOUS_TIME);
    s->state.mode = EVENT;
    return fmi2OK;
}

fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *info)
{
    Instance *s = c;
    REQUIRE(s, EVENT);
    memset(info, 0, sizeof *info);
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
    Instance *s = c;
    (void)no_set_state_prior;
    REQUIRE(s, CONTINUOUS_TIME);
    *enter_event_mode = fmi2False;
    *terminate = fmi2False;
    return fmi2OK;
}

fmi2Status fmi2SetTime(fmi2Component c, fmi2Real time)
{
    Instance *s = c;
    REQUIRE(s, EVENT | CONTINUOUS_TIME);
    if (!isfinite(time)) {
        return fail(s, "%s: the time was set to %g s", __func__, time);
    }
    s->state.time = time;
    return fmi2OK;
}

/* An array of another length than the model's would be read or written beyond its end. */
static fmi2Status check_length(const Instance *s, const char *function, size_t n, int expected)
{
    return n == (size_t)expected ? fmi2OK
                                 : fail(s, "%s: an array of %u values was given, expected %d", function, (unsigned)n,
                                        expected);
}

fmi2Status fmi2SetContinuousStates(fmi2Component c, const fmi2Real x[], size_t n)
{
    Instance *s = c;
    REQUIRE(s, CONTINUOUS_TIME);
    if (check_length(s, __func__, n, NX) != fmi2OK) {
        return fmi2Error;
    }
    const int bad = first_not_finite(x, 0, NX);
    if (bad >= 0) {
        return fail(s, "%s was set to %g at t = %.9g s, expected a finite number", NAMES[bad], x[bad],
                    s->state.time);
    }
    memcpy(s->state.values, x, NX * sizeof *x);
    s->state.fresh = 0;
    return fmi2OK;
}

fmi2Status fmi2GetContinuousStates(fmi2Component c, fmi2Real x[], size_t n)
{
    Instance *s = c;
    if (check_length(s, __func__, n, NX) != fmi2OK) {
        return fmi2Error;
    }
    memcpy(x, s->state.values, NX * sizeof *x);
    return fmi2OK;
}

fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real dx[], size_t n)
{
    Instance *s = c;
    REQUIRE(s, INITIALIZATION | EVENT | CONTINUOUS_TIME);
    if (check_length(s, __func__, n, NX) != fmi2OK) {
        return fmi2Error;
    }
    refresh(&s->state);
    memcpy(dx, s->state.values + FIRST_DX, NX * sizeof *dx);
    const int bad = first_not_finite(dx, 0, NX);
    return bad < 0 ? fmi2OK : fail(s, "%s is %g at t = %.9g s", NAMES[FIRST_DX + bad], dx[bad], s->state.time);
}

fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component c, fmi2Real nominal[], size_t n)
{
    Instance *s = c;
    if (check_length(s, __func__, n, NX) != fmi2OK) {
        return fmi2Error;
    }
    for (int i = 0; i < NX; i++) {
        nominal[i] = 1.0;
    }
    return fmi2OK;
}

fmi2Status fmi2GetEventIndicators(fmi2Component c, fmi2Real indicators[], size_t n)
{
    (void)indicators;
    return check_length(c, __func__, n, 0);
}
