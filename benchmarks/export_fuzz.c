/* The functions of an FMU in random order with random arguments, legal and not, for `export.py` and a test: whatever is
 * called, nothing may be read or written that is not the FMU's, and no behaviour be undefined.
 *
 *     cc -g -fsanitize=address,undefined -fno-sanitize-recover=all -I sources export_fuzz.c -lm && ./a.out CALLS SEED
 *
 * What the standard leaves to the importer is kept: handles are real ones or NULL, arrays are as long as is said.
 */
#include "all.c"

#include <stdint.h>

enum { ROOM = 64, MOST = 6, STATES = 3 };

static uint64_t seed;

static unsigned pick(unsigned below)
{
    seed ^= seed << 13, seed ^= seed >> 7, seed ^= seed << 17;
    return (unsigned)(seed >> 33) % below;
}

static double any_number(void)
{
    static const double values[] = {0.0, 1.0, -1.0, 0.5, 3.0, 1e-3, 1e300, -1e300, INFINITY, NAN};
    return pick(9) ? ((double)pick(2000) - 1000.0) / 500.0 : values[pick(sizeof values / sizeof *values)];
}

static double span(void)
{
    static const double values[] = {1e-3, 1e-3, 1e-2, 2e-2, 0.0, -1e-3, INFINITY, NAN};
    return values[pick(8)];
}

#if FMI == 2
typedef fmi2Component Handle;
typedef fmi2FMUstate Saved;
typedef fmi2Byte Byte;
#define F(name) fmi2##name
#define GetFMUState_ fmi2GetFMUstate
#define SetFMUState_ fmi2SetFMUstate
#define FreeFMUState_ fmi2FreeFMUstate
#define Size_ fmi2SerializedFMUstateSize
#define Serialize_ fmi2SerializeFMUstate
#define Deserialize_ fmi2DeSerializeFMUstate

static void heard(fmi2ComponentEnvironment e, fmi2String i, fmi2Status s, fmi2String c, fmi2String m, ...)
{
    (void)e, (void)i, (void)s, (void)c;
    if (strlen(m) > 511 || strchr(m, '%')) {
        abort();
    }
}

static Handle make(int co_simulation)
{
    static const fmi2CallbackFunctions importer = {heard, NULL, NULL, NULL, NULL};
    return fmi2Instantiate(pick(9) ? "fuzzed" : NULL, co_simulation ? fmi2CoSimulation : fmi2ModelExchange,
                           pick(9) ? MODEL_TOKEN : "other", NULL, pick(20) ? &importer : NULL, 0, 0);
}
#else
typedef fmi3Instance Handle;
typedef fmi3FMUState Saved;
typedef fmi3Byte Byte;
#define F(name) fmi3##name
#define GetFMUState_ fmi3GetFMUState
#define SetFMUState_ fmi3SetFMUState
#define FreeFMUState_ fmi3FreeFMUState
#define Size_ fmi3SerializedFMUStateSize
#define Serialize_ fmi3SerializeFMUState
#define Deserialize_ fmi3DeserializeFMUState

static Handle handle_of_callback;

static void heard(fmi3InstanceEnvironment e, fmi3Status s, fmi3String c, fmi3String m)
{
    (void)e, (void)s, (void)c;
    if (strlen(m) > 511) {
        abort();
    }
}

static void update(fmi3InstanceEnvironment e, double time, bool set, bool get, bool done, bool early, bool *wanted,
                   double *until)
{
    (void)e, (void)set, (void)get, (void)done, (void)early;
    const unsigned r = pick(N_REFERENCES + 2);
    double values[ROOM] = {any_number()};
    (pick(2) ? fmi3SetFloat64(handle_of_callback, &r, 1, values, ROOM)
             : fmi3GetFloat64(handle_of_callback, &r, 1, values, ROOM));
    if (pick(20) == 0) {
        fmi3Terminate(handle_of_callback);
    }
    *wanted = pick(4) == 0;
    *until = pick(4) ? time + span() : any_number();
}

static Handle make(int co_simulation)
{
    const char *name = pick(9) ? "fuzzed" : NULL, *token = pick(9) ? MODEL_TOKEN : NULL;
    return co_simulation ? fmi3InstantiateCoSimulation(name, token, NULL, 0, 0, pick(20) == 0, pick(2), NULL, 0, NULL,
                                                       pick(9) ? heard : NULL, pick(2) ? update : NULL)
                         : fmi3InstantiateModelExchange(name, token, NULL, 0, 0, NULL, heard);
}
#endif

static Handle handle;
static Saved saved[STATES];
static double now;

/* The way through the standard, so that more than refusals is met. */
static void begin_run(void)
{
    if (!handle) {
        handle = make((int)pick(2));
    }
    if (pick(2)) {
        F(Reset)(handle);
    }
#if FMI == 2
    fmi2SetupExperiment(handle, 0, 0, 0.0, 0, 0.0);
    fmi2EnterInitializationMode(handle);
    fmi2ExitInitializationMode(handle);
    fmi2EnterContinuousTimeMode(handle);
#else
    fmi3EnterInitializationMode(handle, 0, 0, 0.0, 0, 0.0);
    fmi3ExitInitializationMode(handle);
    fmi3EnterContinuousTimeMode(handle);
#endif
    now = 0.0;
}

static void values_call(unsigned what)
{
    unsigned r[MOST];
    double x[ROOM];
    const size_t n = pick(MOST + 1);
    double *array = pick(30) ? x : NULL;
    for (int k = 0; k < MOST; k++) {
        r[k] = pick(N_REFERENCES + 3);
    }
    for (int k = 0; k < ROOM; k++) {
        x[k] = any_number();
    }
#if FMI == 2
    int flags[MOST] = {0};
    switch (what) {
    case 0: fmi2GetReal(handle, r, n, array); break;
    case 1: fmi2SetReal(handle, r, n, array); break;
    case 2: fmi2GetBoolean(handle, r, n, flags); break;
    case 3: fmi2SetBoolean(handle, r, n, flags); break;
    case 4: fmi2GetInteger(handle, r, n, flags); break;
    default: fmi2SetString(handle, r, n, NULL); break;
    }
#else
    bool flags[MOST] = {0};
    const size_t room = pick(4) ? ROOM : n;
    switch (what) {
    case 0: fmi3GetFloat64(handle, r, n, array, room); break;
    case 1: fmi3SetFloat64(handle, r, n, array, room); break;
    case 2: fmi3GetBoolean(handle, r, n, flags, MOST); break;
    case 3: fmi3SetBoolean(handle, r, n, flags, MOST); break;
    case 4: fmi3GetInt32(handle, r, n, NULL, n); break;
    default: fmi3GetClock(handle, r, n, NULL); break;
    }
#endif
}

static void derivative_call(int back)
{
    unsigned u[MOST], z[MOST];
    double seeds[ROOM], result[ROOM];
    const size_t nu = pick(MOST + 1), nz = pick(MOST + 1);
    for (int k = 0; k < MOST; k++) {
        u[k] = pick(N_REFERENCES + 1), z[k] = pick(N_REFERENCES + 1);
    }
    for (int k = 0; k < ROOM; k++) {
        seeds[k] = any_number();
    }
#if FMI == 2
    (void)back;
    fmi2GetDirectionalDerivative(handle, u, nu, z, nz, pick(30) ? seeds : NULL, result);
#else
    (back ? fmi3GetAdjointDerivative : fmi3GetDirectionalDerivative)(handle, u, nu, z, nz, seeds, pick(3) ? ROOM : nz,
                                                                    result, pick(3) ? ROOM : nu);
#endif
}

static void state_call(unsigned what)
{
    static Byte bytes[SERIALIZED_SIZE + 16];
    Saved *one = &saved[pick(STATES)];
    size_t size = SERIALIZED_SIZE;
    switch (what) {
    case 0: GetFMUState_(handle, one); break;
    case 1: SetFMUState_(handle, *one); break;
    case 2: FreeFMUState_(handle, one); break;
    case 3: Size_(handle, *one, &size); break;
    case 4: Serialize_(handle, *one, bytes, pick(4) ? sizeof bytes : pick(SERIALIZED_SIZE)); break;
    default: Deserialize_(handle, bytes, pick(4) ? sizeof bytes : pick(SERIALIZED_SIZE), one); break;
    }
}

static void model_exchange_call(unsigned what)
{
    double x[ROOM];
    const size_t n = pick(4) ? (what == 4 ? RANGED : NX) : pick(ROOM);
    for (int k = 0; k < ROOM; k++) {
        x[k] = any_number();
    }
    switch (what) {
    case 0: F(SetContinuousStates)(handle, x, n); break;
    case 1: F(GetContinuousStates)(handle, x, n); break;
#if FMI == 2
    case 2: fmi2GetDerivatives(handle, x, n); break;
#else
    case 2: fmi3GetContinuousStateDerivatives(handle, x, n); break;
#endif
    case 3: F(GetNominalsOfContinuousStates)(handle, x, n); break;
    case 4: F(GetEventIndicators)(handle, x, n); break;
    case 5: F(SetTime)(handle, any_number()); break;
    case 6: F(EnterEventMode)(handle); break;
    case 7: F(EnterContinuousTimeMode)(handle); break;
    default: {
#if FMI == 2
        fmi2EventInfo info;
        fmi2Boolean a, b;
        pick(2) ? fmi2NewDiscreteStates(handle, &info) : fmi2CompletedIntegratorStep(handle, 1, &a, &b);
#else
        bool f[5];
        double t;
        pick(2) ? fmi3UpdateDiscreteStates(handle, f, f + 1, f + 2, f + 3, f + 4, &t)
                : fmi3CompletedIntegratorStep(handle, 1, f, f + 1);
#endif
    }
    }
}

static void co_simulation_call(unsigned what)
{
    const double h = span(), t = pick(9) ? now : any_number();
    const unsigned r = pick(N_REFERENCES + 1);
    const int order = (int)pick(6);
    double x[ROOM] = {any_number()};
#if FMI == 2
    switch (what) {
    case 0: fmi2SetRealInputDerivatives(handle, &r, 1, &order, x); return;
    case 1: fmi2GetRealOutputDerivatives(handle, &r, 1, &order, x); return;
    case 2: fmi2CancelStep(handle); return;
    default: now = fmi2DoStep(handle, t, h, 1) == fmi2OK ? t + h : now;
    }
#else
    bool a, b, c;
    double last = now;
    handle_of_callback = handle;
    switch (what) {
    case 0: fmi3GetOutputDerivatives(handle, &r, 1, &order, x, ROOM); return;
    case 1: fmi3EnterStepMode(handle); return;
    default: now = fmi3DoStep(handle, t, h, 1, &a, &b, &c, &last) == fmi3OK ? last : now;
    }
#endif
}

int main(int count, char **arguments)
{
    const long calls = count > 1 ? atol(arguments[1]) : 1000;
    seed = 0x9e3779b97f4a7c15u * (count > 2 ? (uint64_t)atol(arguments[2]) + 1 : 1);
    for (long k = 0; k < calls; k++) {
        const unsigned what = pick(100);
        if (what < 2) {
            F(FreeInstance)(handle);
            handle = make((int)pick(2));
        } else if (what < 3) {
            F(Reset)(handle);
        } else if (what < 8) {
            begin_run();
        } else if (what < 9) {
            pick(2) ? F(Terminate)(handle) : F(EnterInitializationMode)
#if FMI == 2
            (handle);
#else
            (handle, 0, 0.0, any_number(), 1, any_number());
#endif
        } else if (what < 35) {
            values_call(pick(6));
        } else if (what < 45) {
            derivative_call((int)pick(2));
        } else if (what < 60) {
            state_call(pick(6));
        } else if (what < 80) {
            model_exchange_call(pick(9));
        } else {
            co_simulation_call(pick(8));
        }
    }
    F(FreeInstance)(handle);
    for (int k = 0; k < STATES; k++) {
        FreeFMUState_(NULL, &saved[k]);
    }
    printf("%ld\n", calls);
    return 0;
}
