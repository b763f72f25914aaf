/* An instance of the model and its life cycle: what FMI 2 and FMI 3 have in common, in words of neither.
 * `Importer` and `tell` are those of the version that includes this. */

/* The statuses of both versions. */
typedef int Status;
enum { OK = 0, WARNING = 1, DISCARD = 2, FAILED = 3 };

typedef unsigned int Reference;

/* The modes of the state machines, as bits so that a set of them is one number. */
enum {
    INSTANTIATED = 1,
    INITIALIZATION = 2,
    STEP = 4,
    EVENT = 8,
    CONTINUOUS_TIME = 16,
    TERMINATED = 32,
    INTERMEDIATE = 64 /* inside a communication step, in the importer's callback */
};
enum { BEFORE_START = INSTANTIATED | INITIALIZATION, RUNNING = STEP | EVENT | CONTINUOUS_TIME };
enum { OUTSIDE_OF_STEPS = BEFORE_START | RUNNING | TERMINATED };

typedef struct {
    State state; /* first, for it has to be aligned */
    void *memory; /* as it was allocated */
    int co_simulation;
    Importer importer;
    char name[]; /* C99: as long as it was allocated */
} Instance;

/* Hands a text to the importer. */
static void tell(const Instance *s, Status status, const char *category, const char *text);

static void say(const Instance *s, Status status, const char *category, const char *format, va_list arguments)
{
    char text[512];

    vsnprintf(text, sizeof text, format, arguments);
    for (char *c = text; *c; c++) {
        if (*c == '%') { /* the importer may read the text as a format again */
            *c = '?';
        }
    }
    tell(s, status, category, text);
}

/* Tells the importer what went wrong, in printf's manner, and gives the status to return. */
static Status fail(const Instance *s, const char *format, ...)
{
    va_list arguments;
    va_start(arguments, format);
    if (s) {
        say(s, FAILED, "logStatusError", format, arguments);
    }
    va_end(arguments);
    return FAILED;
}

#if RANGED || CONTROLLER
static void warn(const Instance *s, const char *format, ...)
{
    va_list arguments;
    va_start(arguments, format);
    say(s, WARNING, "logStatusWarning", format, arguments);
    va_end(arguments);
}
#endif

static const char *mode_name(int mode)
{
    switch (mode) {
    case INSTANTIATED: return "instantiated";
    case INITIALIZATION: return "initialization";
    case STEP: return "step complete";
    case EVENT: return "event";
    case CONTINUOUS_TIME: return "continuous time";
    case INTERMEDIATE: return "intermediate update";
    default: return "terminated";
    }
}

/* Whether the instance is in one of the modes in which a function may be called. */
static int allowed(const Instance *s, int modes, const char *function)
{
    if (!s) {
        return 0;
    }
    if (s->state.mode & modes) {
        return 1;
    }
    fail(s, "%s may not be called in mode '%s' of this %s instance", function, mode_name(s->state.mode),
         s->co_simulation ? "Co-Simulation" : "Model Exchange");
    return 0;
}

#define REQUIRE(s, modes) \
    do { \
        if (!allowed((s), (modes), __func__)) { \
            return FAILED; \
        } \
    } while (0)

/* What an importer must give where it may not give nothing. */
#define REQUIRE_ARRAY(s, array, count) \
    do { \
        if ((count) && !(array)) { \
            return fail((s), "%s: an array is missing (null pointer)", __func__); \
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

static Instance *create(const char *name, const char *token, int co_simulation, const Importer *importer)
{
    name = name ? name : "";
    enum { ALIGNED = 64 };
    char *memory = calloc(1, ALIGNED + sizeof(Instance) + strlen(name) + 1);
    if (!memory) {
        return NULL;
    }
    Instance *s = (Instance *)(memory + ALIGNED - (uintptr_t)memory % ALIGNED);
    s->memory = memory;
    s->co_simulation = co_simulation;
    s->importer = *importer;
    strcpy(s->name, name);
    begin(&s->state);
    if (!token || strcmp(token, MODEL_TOKEN)) {
        fail(s, "the token is %s, expected %s: modelDescription.xml and binary are not of one build of "
             MODEL_IDENTIFIER, token ? token : "missing", MODEL_TOKEN);
        free(memory);
        return NULL;
    }
#if CONTROLLER
    if (!co_simulation) {
        fail(s, "a controller is for Co-Simulation alone");
        free(memory);
        return NULL;
    }
#endif
    return s;
}

static void destroy(Instance *s)
{
    if (s) {
        free(s->memory);
    }
}

static Status set_experiment(Instance *s, double start_time, int stop_defined, double stop_time)
{
    if (!isfinite(start_time) || (stop_defined && !(stop_time >= start_time))) {
        return fail(s, "the start time is %g s, the stop time %g s", start_time, stop_time);
    }
    s->state.values[TIME] = start_time;
    s->state.stop_time = stop_defined ? stop_time : INFINITY;
    return OK;
}

/* Says so, once, when the model leaves the range that it was trained in. */
static void mind_range(Instance *s)
{
    refresh_events(&s->state);
#if RANGED
    const int outside = s->state.values[IN_RANGE] == 0.0;
    if (outside && !s->state.outside) {
        int k;
        double slope;
        margin(s->state.values, &k, &slope);
        warn(s, "%s is %g at t = %.9g s, the model was trained from %g to %g: %s", NAMES[RANGE_OF[k]],
             s->state.values[RANGE_OF[k]], s->state.values[TIME], LOW[k], HIGH[k],
             clamped(s->state.values) ? "it is evaluated at the end of that range" : "it extrapolates");
    }
    s->state.outside = outside;
#endif
}

static void enter_initialization(Instance *s)
{
    start_core(&s->state);
    s->state.mode = INITIALIZATION;
}

static Status start(Instance *s)
{
    refresh(&s->state);
    const int bad = first_not_finite(s->state.values, FIRST_DX, NX);
    if (bad >= 0) {
        return fail(s, "%s is %g at the start; check the parameters and the initial state", NAMES[bad],
                    s->state.values[bad]);
    }
    mind_range(s);
    s->state.mode = s->co_simulation ? STEP : EVENT;
    return OK;
}

#define MOST_STEPS 1e9 /* internal steps in a communication step: more are taken for a mistake */

/* A communication step from t to t + h, or less if `between` says so. */
static Status step(Instance *s, const char *function, double t, double h, double *end, Between *between)
{
    double *time = &s->state.values[TIME];
    if (!isfinite(h) || h <= 0.0) {
        return fail(s, "%s: the step size is %g s at t = %.9g s, expected a positive number", function, h, t);
    }
    const double rounding = 1e-9 * (fabs(*time) + h);
    if (!(fabs(t - *time) <= rounding)) {
        return fail(s, "%s: the importer is at t = %.17g s, this model at t = %.17g s", function, t, *time);
    }
    if (t + h > s->state.stop_time + rounding) {
        return fail(s, "%s: a step from %.9g s to %.9g s goes past the stop time %.9g s", function, t, t + h,
                    s->state.stop_time);
    }
#if CONTROLLER
    (void)between;
    if (h / SAMPLE > MOST_STEPS) {
        return fail(s, "%s: a step of %g s is one of too many samples of %g s", function, h, SAMPLE);
    }
    *time = t;
    *end = h;
    refresh(&s->state);
    const double status = s->state.values[M_STATUS];
    if (s->state.due && status != NMPC_SOLVED) {
        warn(s, "t = %.9g s: %s", t, status == NMPC_LIMIT ? "the solver ended at its iteration limit"
                                                          : "the solver failed, the input is the fallback's");
    }
    pass(&s->state, h);
#else
    if (s->state.values[SOLVER_TOLERANCE] == 0.0 && h / s->state.values[SOLVER_STEP] > MOST_STEPS) {
        return fail(s, "%s: a step of %g s in internal steps of %g s is one of too many; make the parameter solver_step "
                    "larger", function, h, s->state.values[SOLVER_STEP]);
    }
    *time = t; /* the importer's clock is the one that counts */
    const int bad = advance(&s->state, h, end, between, s);
    if (bad >= 0) {
        return s->state.values[SOLVER_TOLERANCE] > 0.0
                   ? fail(s, "%s cannot be followed in the step from t = %.9g s to %.9g s within the solver_tolerance of "
                          "%g: it may have gone to infinity", NAMES[bad], t, t + h, s->state.values[SOLVER_TOLERANCE])
                   : fail(s, "%s is no longer finite in the step from t = %.9g s to %.9g s; if the model is stiffer "
                          "than at its default parameters, make the parameter solver_step (%g s) smaller",
                          NAMES[bad], t, t + h, s->state.values[SOLVER_STEP]);
    }
    mind_range(s);
#endif
    return OK;
}

/* ── values ─────────────────────────────────────────────────────────────────────────────────────────────── */

/* A value reference is an index; in FMI 3 the two behind the last one stand for x and dx as arrays. */
enum { VECTOR_X = N_VALUES, VECTOR_DX, N_REFERENCES = FMI == 3 ? VECTOR_DX + 1 : N_VALUES };

/* How many values a reference stands for, and where they begin; 0 if there is no such reference. */
static size_t find(Reference r, int *first)
{
    *first = r == VECTOR_X ? 0 : r == VECTOR_DX ? FIRST_DX : (int)r;
    return r < N_VALUES ? 1 : r < N_REFERENCES ? NX : 0;
}

/* Whether a value is a truth value. */
static int is_boolean(int index)
{
#if RANGED
    return index == CLAMP || index == IN_RANGE;
#else
    (void)index;
    return 0;
#endif
}

/* Where the values of a reference of the wanted type begin; their number is 0, and the reason told, if it is none. */
static size_t look_up(const Instance *s, const char *function, Reference r, int boolean, int *first)
{
    const size_t count = find(r, first);
    if (!count) {
        fail(s, "%s: there is no value reference %u, the last one is %d", function, r, N_VALUES - 1);
    } else if (is_boolean(*first) != boolean) {
        fail(s, "%s: %s is of type %s", function, NAMES[*first], boolean ? "real" : "Boolean");
        return 0;
    }
    return count;
}

/* The modes in which a value may be set: settings and, where the model integrates itself, states before the start,
 * inputs and parameters also later on, derivatives and outputs never. This is wider than the standard for Model
 * Exchange, because CasADi, which reads FMUs as functions, sets states and parameters in continuous-time mode. */
static int settable(int index)
{
    if (index < FIRST_U) {
        return BEFORE_START | EVENT | CONTINUOUS_TIME;
    }
#if CONTROLLER && CLOSED
    return index < N_KNOWN ? BEFORE_START : 0; /* what is measured moves by itself */
#endif
    if (index < N_KNOWN) {
        return BEFORE_START | RUNNING | (index < FIRST_P ? INTERMEDIATE : 0);
    }
    return index < FIRST_DX ? BEFORE_START : 0;
}

/* Brings what depends on the rest up to date where it is asked for. */
static void refresh_for(Instance *s, int index)
{
    if (index >= FIRST_DX && index != TIME) {
        refresh(&s->state);
        if (s->state.mode != CONTINUOUS_TIME) {
            refresh_events(&s->state);
        }
    }
}

static Status get_reals(Instance *s, const char *function, const Reference r[], size_t n, double value[], size_t room)
{
    Status status = OK;
    size_t k = 0;

    for (size_t j = 0; j < n; j++) {
        int first;
        const size_t count = look_up(s, function, r[j], 0, &first);
        if (!count) {
            return FAILED;
        }
        if (k + count > room) {
            return fail(s, "%s: room for %u values, needed are more", function, (unsigned)room);
        }
        refresh_for(s, first);
        for (size_t i = 0; i < count; i++, k++) {
            value[k] = s->state.values[first + i];
            if (!isfinite(value[k])) {
                status = fail(s, "%s is %g at t = %.9g s", NAMES[first + i], value[k], s->state.values[TIME]);
            }
        }
    }
    return status;
}

/* Whether a value may become this. */
static Status check_value(const Instance *s, int index, double value)
{
    const char *name = NAMES[index];
    if (!(s->state.mode & settable(index))) {
        return fail(s, "%s may not be set in mode '%s'", name, mode_name(s->state.mode));
    }
#if !CONTROLLER /* which knows what to do without a measurement */
    if (!isfinite(value)) {
        return fail(s, "%s was set to %g at t = %.9g s, expected a finite number", name, value, s->state.values[TIME]);
    }
    if (index == SOLVER_STEP && value <= 0.0) {
        return fail(s, "%s was set to %g s, expected a positive number", name, value);
    }
    if (index == SOLVER_TOLERANCE && (value < 0.0 || value >= 1.0)) {
        return fail(s, "%s was set to %g, expected 0 or a number below 1", name, value);
    }
#endif
    return OK;
}

/* All is checked before anything is set. */
static Status set_reals(Instance *s, const char *function, const Reference r[], size_t n, const double value[],
                        size_t room)
{
    for (int setting = 0; setting <= 1; setting++) {
        size_t k = 0;
        for (size_t j = 0; j < n; j++) {
            int first;
            const size_t count = look_up(s, function, r[j], 0, &first);
            if (!count) {
                return FAILED;
            }
            if (k + count > room) {
                return fail(s, "%s: %u values were given, needed are more", function, (unsigned)room);
            }
            for (size_t i = 0; i < count; i++, k++) {
                if (setting) {
                    s->state.values[first + i] = value[k];
                } else if (check_value(s, first + (int)i, value[k]) != OK) {
                    return FAILED;
                }
            }
        }
    }
    s->state.fresh = 0;
    return OK;
}

static Status get_boolean(Instance *s, const char *function, Reference r, int *value)
{
    int first;
    if (!look_up(s, function, r, 1, &first)) {
        return FAILED;
    }
    refresh_for(s, first);
    *value = s->state.values[first] != 0.0;
    return OK;
}

static Status set_boolean(Instance *s, const char *function, Reference r, int value)
{
    int first;
    if (!look_up(s, function, r, 1, &first) || check_value(s, first, value) != OK) {
        return FAILED;
    }
    s->state.values[first] = value != 0;
    s->state.fresh = 0;
    return OK;
}

/* ── continuous states ──────────────────────────────────────────────────────────────────────────────────── */

/* An array of another length than the model's would be read or written beyond its end. */
static Status check_length(const Instance *s, const char *function, const void *array, size_t n, int expected)
{
    return n != (size_t)expected ? fail(s, "%s: an array of %u values was given, expected %d", function, (unsigned)n,
                                        expected)
           : n && !array         ? fail(s, "%s: an array is missing (null pointer)", function)
                                 : OK;
}

static Status set_states(Instance *s, const char *function, const double x[], size_t n)
{
    if (check_length(s, function, x, n, NX) != OK) {
        return FAILED;
    }
    const int bad = first_not_finite(x, 0, NX);
    if (bad >= 0) {
        return fail(s, "%s was set to %g at t = %.9g s, expected a finite number", NAMES[bad], x[bad],
                    s->state.values[TIME]);
    }
    memcpy(s->state.values, x, NX * sizeof *x);
    s->state.fresh = 0;
    return OK;
}

static Status get_states(Instance *s, const char *function, double x[], size_t n)
{
    if (check_length(s, function, x, n, NX) != OK) {
        return FAILED;
    }
    memcpy(x, s->state.values, NX * sizeof *x);
    return OK;
}

static Status get_derivatives(Instance *s, const char *function, double dx[], size_t n)
{
    if (check_length(s, function, dx, n, NX) != OK) {
        return FAILED;
    }
    refresh(&s->state);
    memcpy(dx, s->state.values + FIRST_DX, NX * sizeof *dx);
    const int bad = first_not_finite(dx, 0, NX);
    return bad < 0 ? OK : fail(s, "%s is %g at t = %.9g s", NAMES[FIRST_DX + bad], dx[bad], s->state.values[TIME]);
}

static Status get_nominals(Instance *s, const char *function, double nominal[], size_t n)
{
    if (check_length(s, function, nominal, n, NX) != OK) {
        return FAILED;
    }
    memcpy(nominal, NOMINAL, NX * sizeof *nominal);
    return OK;
}

/* The margin is an event indicator: the model leaves its range, or comes back, where it changes its sign. */
static Status get_indicators(Instance *s, const char *function, double indicators[], size_t n)
{
    if (check_length(s, function, indicators, n, RANGED) != OK) {
        return FAILED;
    }
#if RANGED
    refresh(&s->state);
    *indicators = s->state.values[MARGIN];
#endif
    return OK;
}

static Status set_time(Instance *s, const char *function, double time)
{
    if (!isfinite(time)) {
        return fail(s, "%s: the time was set to %g s", function, time);
    }
    s->state.values[TIME] = time;
    return OK;
}

/* ── FMU state ──────────────────────────────────────────────────────────────────────────────────────────── */

/* A serialised state begins with the token of the model, so that one of another model is refused. */
enum { TOKEN_SIZE = sizeof MODEL_TOKEN, SERIALIZED_SIZE = TOKEN_SIZE + sizeof(State) };

static Status get_state(Instance *s, void **copy)
{
    if (!copy) {
        return fail(s, "no place for the FMU state was given (null pointer)");
    }
    if (!*copy) {
        *copy = malloc(sizeof(State));
    }
    if (!*copy) {
        return fail(s, "out of memory for the FMU state");
    }
    memcpy(*copy, &s->state, sizeof(State));
    return OK;
}

static Status set_state(Instance *s, const void *copy)
{
    if (!copy) {
        return fail(s, "no FMU state was given (null pointer)");
    }
    memcpy(&s->state, copy, sizeof(State));
    return OK;
}

static Status free_state(void **copy)
{
    if (copy) {
        free(*copy);
        *copy = NULL;
    }
    return OK;
}

static Status serialize(Instance *s, const void *copy, void *bytes, size_t size)
{
    if (!copy || !bytes || size < SERIALIZED_SIZE) {
        return fail(s, "an FMU state and room for %d bytes are needed, found room for %u", (int)SERIALIZED_SIZE,
                    bytes ? (unsigned)size : 0);
    }
    memcpy(bytes, MODEL_TOKEN, TOKEN_SIZE);
    memcpy((char *)bytes + TOKEN_SIZE, copy, sizeof(State));
    return OK;
}

static Status deserialize(Instance *s, const void *bytes, size_t size, void **copy)
{
    if (!bytes || size < SERIALIZED_SIZE || memcmp(bytes, MODEL_TOKEN, TOKEN_SIZE)) {
        return fail(s, "these bytes are not a state of this build of " MODEL_IDENTIFIER);
    }
    const Status status = get_state(s, copy);
    if (status == OK) {
        memcpy(*copy, (const char *)bytes + TOKEN_SIZE, sizeof(State));
    }
    return status;
}

/* ── derivatives ────────────────────────────────────────────────────────────────────────────────────────── */

/* Whether a value follows from others by the equations, or is one that they follow from. */
static int is_unknown(int index)
{
    return index < FIRST_U || (index >= FIRST_DX && !is_boolean(index) && index != TIME);
}

static int is_known(int index)
{
    return index < N_KNOWN || index == TIME;
}

/* Adds the numbers that an importer gave for some values to an array of all, or the other way round. */
static Status exchange(Instance *s, const char *function, int (*fits)(int), const char *what, const Reference r[],
                       size_t n, double all[], const double *given, double *wanted, size_t room)
{
    size_t k = 0;
    for (size_t j = 0; j < n; j++) {
        int first;
        const size_t count = find(r[j], &first);
        if (!count || !fits(first)) {
            return fail(s, "%s: value reference %u is no %s", function, r[j], what);
        }
        if (k + count > room) {
            return fail(s, "%s: the array of %u values is too short", function, (unsigned)room);
        }
        for (size_t i = 0; i < count; i++, k++) {
            if (given) {
                all[first + i] += given[k];
            } else {
                wanted[k] = all[first + i];
                if (!isfinite(wanted[k])) {
                    return fail(s, "the derivative of, or by, %s is %g at t = %.9g s", NAMES[first + i], wanted[k],
                                s->state.values[TIME]);
                }
            }
        }
    }
    return OK;
}

#if CONTROLLER
static void tangent_of_all(State *s, const double *direction, double *change)
{
    (void)s, (void)direction; /* of a solution there is none: providesDirectionalDerivative is false */
    for (int i = 0; i < N_VALUES; i++) {
        change[i] = NAN;
    }
}

#define adjoint_of_all tangent_of_all
#endif

#define UNKNOWN is_unknown, "state, derivative or output"
#define KNOWN is_known, "state, input or parameter"

static Status directional(Instance *s, const char *function, const Reference unknown[], size_t n_unknown,
                          const Reference known[], size_t n_known, const double seed[], size_t n_seed, double result[],
                          size_t n_result)
{
    double direction[N_VALUES] = {0}, change[N_VALUES];

    if (exchange(s, function, KNOWN, known, n_known, direction, seed, NULL, n_seed) != OK) {
        return FAILED;
    }
    tangent_of_all(&s->state, direction, change);
    return exchange(s, function, UNKNOWN, unknown, n_unknown, change, NULL, result, n_result);
}

#if FMI == 3
static Status adjoint_derivative(Instance *s, const char *function, const Reference unknown[], size_t n_unknown,
                                 const Reference known[], size_t n_known, const double seed[], size_t n_seed,
                                 double result[], size_t n_result)
{
    double weight[N_VALUES] = {0}, change[N_VALUES] = {0};

    if (exchange(s, function, UNKNOWN, unknown, n_unknown, weight, seed, NULL, n_seed) != OK) {
        return FAILED;
    }
    adjoint_of_all(&s->state, weight, change);
    return exchange(s, function, KNOWN, known, n_known, change, NULL, result, n_result);
}
#endif

/* First time derivatives of outputs, along the states' and the inputs' own. */
static Status output_derivatives(Instance *s, const char *function, const Reference r[], size_t n, const int order[],
                                 double value[], size_t room)
{
    double direction[N_VALUES] = {0}, change[N_VALUES];

    refresh(&s->state);
    memcpy(direction, s->state.values + FIRST_DX, NX * sizeof *direction);
#if !CONTROLLER
    memcpy(direction + FIRST_U, s->state.slopes[0], NU * sizeof *direction);
#endif
    for (size_t k = 0; k < n; k++) {
        if (order[k] != 1) {
            return fail(s, "%s: the derivative of order %d was asked for, maxOutputDerivativeOrder is 1", function,
                        order[k]);
        }
    }
    tangent_of_all(&s->state, direction, change);
    return exchange(s, function, UNKNOWN, r, n, change, NULL, value, room);
}
