/* Values of all types that FMI 3.0 has, passed through; a state-space model with arrays sized by structural
   parameters; and clocks. An FMI 3.0 Co-Simulation FMU. Value references, in and out being neighbours:

   10 Float32, 20 Int8, 30 UInt8, 40 Int16, 50 UInt16, 60 Int32, 70 UInt32, 80 Int64, 90 UInt64, 100 Boolean,
   110 String, 120 Binary, 130 text array of 2;
   1 m, 2 n, 3 r; 4 A [n][n], 5 B [n][m], 6 C [r][n], 7 D [r][m], 8 x0 [n], 9 u [m], 0 y [r], 14 x [n];
   140 periodic clock, 141 its ticks; 142 countdown clock, 143 its ticks. */

#include <math.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include "fmi3FunctionTypes.h"

#define EXPORT __attribute__((visibility("default")))
#define MOST 5

typedef struct {
    float f32;
    int8_t i8; uint8_t u8; int16_t i16; uint16_t u16; int32_t i32; uint32_t u32; int64_t i64; uint64_t u64;
    bool boolean, configuring, ticked[2], stepping;
    char text[3][200];
    uint8_t bytes[200];
    size_t size;
    uint64_t dimension[4];  /* of 1, 2, 3 */
    double a[MOST * MOST], b[MOST * MOST], c[MOST * MOST], d[MOST * MOST], x0[MOST], u[MOST], x[MOST], y[MOST], time;
    int32_t ticks[2];
} Fmu;

EXPORT fmi3Instance fmi3InstantiateCoSimulation(
    fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible, fmi3Boolean logging,
    fmi3Boolean events, fmi3Boolean early, const fmi3ValueReference intermediate[], size_t n,
    fmi3InstanceEnvironment environment, fmi3LogMessageCallback log, fmi3IntermediateUpdateCallback update) {
    (void)name; (void)token; (void)resources; (void)visible; (void)logging; (void)early; (void)intermediate; (void)n;
    (void)environment; (void)log; (void)update; (void)events;
    Fmu* f = calloc(1, sizeof *f);
    f->dimension[1] = f->dimension[2] = f->dimension[3] = 2;
    for (int k = 0; k < 2; k++) f->a[3 * k] = -1, f->b[3 * k] = f->c[3 * k] = 1;
    return f;
}
EXPORT void fmi3FreeInstance(fmi3Instance c) { free(c); }
EXPORT fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean defined, fmi3Float64 tolerance,
                                              fmi3Float64 t0, fmi3Boolean ends, fmi3Float64 t1) {
    (void)defined; (void)tolerance; (void)ends; (void)t1;
    ((Fmu*)c)->time = t0;
    return fmi3OK;
}
EXPORT fmi3Status fmi3ExitInitializationMode(fmi3Instance c) {
    Fmu* f = c;
    memcpy(f->x, f->x0, sizeof f->x);
    return fmi3OK;
}
EXPORT fmi3Status fmi3Terminate(fmi3Instance c) { (void)c; return fmi3OK; }
EXPORT fmi3Status fmi3EnterConfigurationMode(fmi3Instance c) { ((Fmu*)c)->configuring = true; return fmi3OK; }
EXPORT fmi3Status fmi3ExitConfigurationMode(fmi3Instance c) {
    Fmu* f = c;
    f->configuring = false;
    /* Matrices are stored by rows of the present sizes: identities again. */
    memset(f->a, 0, sizeof f->a), memset(f->b, 0, sizeof f->b), memset(f->c, 0, sizeof f->c);
    return fmi3OK;
}

#define SCALAR(Type, member, base)                                                                          \
    EXPORT fmi3Status fmi3Get##Type(fmi3Instance c, const fmi3ValueReference vr[], size_t n,                \
                                    fmi3##Type values[], size_t size) {                                     \
        (void)vr; (void)size;                                                                               \
        for (size_t k = 0; k < n; k++) values[k] = ((Fmu*)c)->member;                                       \
        return fmi3OK;                                                                                      \
    }                                                                                                       \
    EXPORT fmi3Status fmi3Set##Type(fmi3Instance c, const fmi3ValueReference vr[], size_t n,                \
                                    const fmi3##Type values[], size_t size) {                               \
        (void)vr; (void)size;                                                                               \
        for (size_t k = 0; k < n; k++) ((Fmu*)c)->member = values[k];                                       \
        return fmi3OK;                                                                                      \
    }
SCALAR(Float32, f32, 10)
SCALAR(Int8, i8, 20)
SCALAR(UInt8, u8, 30)
SCALAR(Int16, i16, 40)
SCALAR(UInt16, u16, 50)
SCALAR(UInt32, u32, 70)
SCALAR(Int64, i64, 80)
SCALAR(Boolean, boolean, 100)

EXPORT fmi3Status fmi3GetInt32(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3Int32 values[],
                               size_t size) {
    Fmu* f = c;
    (void)size;
    for (size_t k = 0; k < n; k++) values[k] = vr[k] < 140 ? f->i32 : f->ticks[(vr[k] - 140) / 2];
    return fmi3OK;
}
EXPORT fmi3Status fmi3SetInt32(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3Int32 values[],
                               size_t size) {
    (void)vr; (void)size;
    for (size_t k = 0; k < n; k++) ((Fmu*)c)->i32 = values[k];
    return fmi3OK;
}
EXPORT fmi3Status fmi3GetUInt64(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3UInt64 values[],
                                size_t size) {
    Fmu* f = c;
    (void)size;
    for (size_t k = 0; k < n; k++) values[k] = vr[k] < 4 ? f->dimension[vr[k]] : f->u64;
    return fmi3OK;
}
EXPORT fmi3Status fmi3SetUInt64(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3UInt64 values[],
                                size_t size) {
    Fmu* f = c;
    (void)size;
    for (size_t k = 0; k < n; k++) {
        if (vr[k] < 4 && !f->configuring) return fmi3Error;
        if (vr[k] < 4 && values[k] > MOST) return fmi3Error;
        if (vr[k] < 4) f->dimension[vr[k]] = values[k];
        else f->u64 = values[k];
    }
    return fmi3OK;
}

/* ── texts and binaries ── */
static char* slot(Fmu* f, fmi3ValueReference vr) { return f->text[vr >= 130 ? 1 : 0]; }
EXPORT fmi3Status fmi3GetString(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3String values[],
                                size_t size) {
    Fmu* f = c;
    size_t at = 0;
    for (size_t k = 0; k < n; k++)
        for (int e = 0; e < (vr[k] >= 130 ? 2 : 1); e++) values[at++] = slot(f, vr[k]) + 200 * e;
    return at == size ? fmi3OK : fmi3Error;
}
EXPORT fmi3Status fmi3SetString(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3String values[],
                                size_t size) {
    Fmu* f = c;
    size_t at = 0;
    for (size_t k = 0; k < n; k++)
        for (int e = 0; e < (vr[k] >= 130 ? 2 : 1); e++) strncpy(slot(f, vr[k]) + 200 * e, values[at++], 199);
    return at == size ? fmi3OK : fmi3Error;
}
EXPORT fmi3Status fmi3GetBinary(fmi3Instance c, const fmi3ValueReference vr[], size_t n, size_t sizes[],
                                fmi3Binary values[], size_t size) {
    (void)vr; (void)size;
    for (size_t k = 0; k < n; k++) values[k] = ((Fmu*)c)->bytes, sizes[k] = ((Fmu*)c)->size;
    return fmi3OK;
}
EXPORT fmi3Status fmi3SetBinary(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const size_t sizes[],
                                const fmi3Binary values[], size_t size) {
    (void)vr; (void)size;
    for (size_t k = 0; k < n; k++) memcpy(((Fmu*)c)->bytes, values[k], sizes[k]), ((Fmu*)c)->size = sizes[k];
    return fmi3OK;
}

/* ── the state-space model ── */
static double* array(Fmu* f, fmi3ValueReference vr, size_t* size) {
    size_t m = f->dimension[1], n = f->dimension[2], r = f->dimension[3];
    switch (vr) {
        case 4: *size = n * n; return f->a;
        case 5: *size = n * m; return f->b;
        case 6: *size = r * n; return f->c;
        case 7: *size = r * m; return f->d;
        case 8: *size = n; return f->x0;
        case 9: *size = m; return f->u;
        case 0: *size = r; return f->y;
        default: *size = n; return f->x;
    }
}
EXPORT fmi3Status fmi3GetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3Float64 values[],
                                 size_t size) {
    Fmu* f = c;
    size_t rows = f->dimension[3], states = f->dimension[2], inputs = f->dimension[1], at = 0, count;
    for (size_t i = 0; i < rows; i++) {
        f->y[i] = 0;
        for (size_t j = 0; j < states; j++) f->y[i] += f->c[i * states + j] * f->x[j];
        for (size_t j = 0; j < inputs; j++) f->y[i] += f->d[i * inputs + j] * f->u[j];
    }
    for (size_t k = 0; k < n; k++) {
        double* from = array(f, vr[k], &count);
        memcpy(values + at, from, count * sizeof(double));
        at += count;
    }
    return at == size ? fmi3OK : fmi3Error;
}
EXPORT fmi3Status fmi3SetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                                 const fmi3Float64 values[], size_t size) {
    size_t at = 0, count;
    for (size_t k = 0; k < n; k++) {
        double* to = array(c, vr[k], &count);
        memcpy(to, values + at, count * sizeof(double));
        at += count;
    }
    return at == size ? fmi3OK : fmi3Error;
}

/* ── events and clocks ── */
EXPORT fmi3Status fmi3EnterEventMode(fmi3Instance c) { ((Fmu*)c)->stepping = false; return fmi3OK; }
EXPORT fmi3Status fmi3EnterStepMode(fmi3Instance c) { ((Fmu*)c)->stepping = true; return fmi3OK; }
EXPORT fmi3Status fmi3SetClock(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3Clock values[]) {
    Fmu* f = c;
    if (f->stepping) return fmi3Error;
    for (size_t k = 0; k < n; k++) f->ticked[(vr[k] - 140) / 2] = values[k];
    return fmi3OK;
}
EXPORT fmi3Status fmi3GetIntervalDecimal(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                                         fmi3Float64 intervals[], fmi3IntervalQualifier qualifiers[]) {
    Fmu* f = c;
    for (size_t k = 0; k < n; k++) {
        /* The countdown begins at each fifth tick of the other clock, and takes 0.25 s. */
        bool begun = vr[k] == 142 && f->ticked[0] && f->ticks[0] % 5 == 0;
        intervals[k] = 0.25, qualifiers[k] = begun ? fmi3IntervalChanged : fmi3IntervalNotYetKnown;
    }
    f->ticked[0] = false;
    return fmi3OK;
}
EXPORT fmi3Status fmi3UpdateDiscreteStates(fmi3Instance c, fmi3Boolean* again, fmi3Boolean* terminate,
                                           fmi3Boolean* nominals, fmi3Boolean* states, fmi3Boolean* defined,
                                           fmi3Float64* next) {
    Fmu* f = c;
    for (int k = 0; k < 2; k++) f->ticks[k] += f->ticked[k];
    f->ticked[1] = false;
    *again = *terminate = *nominals = *states = *defined = false, *next = 0;
    return fmi3OK;
}
EXPORT fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 t, fmi3Float64 h, fmi3Boolean undone, fmi3Boolean* needed,
                             fmi3Boolean* terminate, fmi3Boolean* early, fmi3Float64* reached) {
    Fmu* f = c;
    size_t n = f->dimension[2], m = f->dimension[1];
    double dx[MOST];
    (void)undone;
    for (size_t i = 0; i < n; i++) {
        dx[i] = 0;
        for (size_t j = 0; j < n; j++) dx[i] += f->a[i * n + j] * f->x[j];
        for (size_t j = 0; j < m; j++) dx[i] += f->b[i * m + j] * f->u[j];
    }
    for (size_t i = 0; i < n; i++) f->x[i] += h * dx[i];
    *needed = *terminate = *early = false, *reached = f->time = t + h;
    return fmi3OK;
}
