/* FMI 2.0 for Co-Simulation: the model integrates itself, inputs held over each communication step. */

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real t, fmi2Real h, fmi2Boolean no_set_state_prior)
{
    Instance *s = c;
    (void)no_set_state_prior;
    REQUIRE(s, STEP);
    if (!isfinite(h) || h <= 0.0) {
        return fail(s, "%s: the step size is %g s at t = %.9g s, expected a positive number", __func__, h, t);
    }
    const double rounding = 1e-9 * (fabs(s->state.time) + h);
    if (!(fabs(t - s->state.time) <= rounding)) {
        return fail(s, "%s: the importer is at t = %.17g s, this model at t = %.17g s", __func__, t, s->state.time);
    }
    if (t + h > s->state.stop_time + rounding) {
        return fail(s, "%s: a step from %.9g s to %.9g s goes past the stop time %.9g s", __func__, t, t + h,
                    s->state.stop_time);
    }
    s->state.time = t; /* the importer's clock is the one that counts */
    const int bad = advance(&s->state, h);
    if (bad >= 0) {
        return fail(s, "%s is no longer finite in the step from t = %.9g s to %.9g s; if the model is stiffer "
                    "than at its default parameters, make the parameter solver_step (%g s) smaller",
                    NAMES[bad], t, t + h, s->state.values[SOLVER_STEP]);
    }
    return fmi2OK;
}

fmi2Status fmi2CancelStep(fmi2Component c)
{
    return fail(c, "%s: steps are never pending", __func__);
}

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                                       const fmi2Integer order[], const fmi2Real value[])
{
    (void)vr, (void)order, (void)value;
    return n ? fail(c, "%s: inputs are held, canInterpolateInputs is false", __func__) : fmi2OK;
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                                        const fmi2Integer order[], fmi2Real value[])
{
    (void)vr, (void)order, (void)value;
    return n ? fail(c, "%s: maxOutputDerivativeOrder is 0", __func__) : fmi2OK;
}

/* ── status ─────────────────────────────────────────────────────────────────────────────────────────────── */

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value)
{
    Instance *s = c;
    if (kind != fmi2LastSuccessfulTime) {
        return fmi2Discard;
    }
    *value = s->state.time;
    return fmi2OK;
}

fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Boolean *value)
{
    (void)c;
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
