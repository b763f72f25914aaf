/* An FMI 1.0 Co-Simulation FMU: dx/dt = gain u by Euler's method, an integer, a Boolean and a text passed through.
   From t = 0.5 s on, fmiDoStep returns FAULT where that is defined. */

#include <stddef.h>
#include <stdlib.h>
#include <string.h>

#define EXPORT __attribute__((visibility("default")))
#define N(name) Model_fmi##name

typedef struct {
    void (*logger)(void*, const char*, int, const char*, const char*, ...);
    void* (*allocate)(size_t, size_t);
    void (*release)(void*);
    void (*finished)(void*, int);
} Callbacks;

typedef struct {
    double real[3], time;
    int integer[2], initialized;
    char boolean[2], text[200];
    Callbacks calls;
} Slave;

EXPORT const char* N(GetTypesPlatform)(void) { return "standard32"; }
EXPORT const char* N(GetVersion)(void) { return "1.0"; }
EXPORT int N(SetDebugLogging)(void* c, char on) { (void)c; (void)on; return 0; }
EXPORT void* N(InstantiateSlave)(const char* name, const char* guid, const char* location, const char* mime,
                                 double timeout, char visible, char interactive, Callbacks calls, char logging) {
    (void)name; (void)location; (void)mime; (void)timeout; (void)visible; (void)interactive; (void)logging;
    if (strcmp(guid, "g")) return NULL;
    Slave* s = calls.allocate(1, sizeof *s);
    s->calls = calls, s->real[1] = 2;
    return s;
}
EXPORT int N(InitializeSlave)(void* c, double t0, char ends, double t1) {
    (void)ends; (void)t1;
    ((Slave*)c)->time = t0, ((Slave*)c)->initialized = 1;
    return 0;
}
EXPORT int N(TerminateSlave)(void* c) { (void)c; return 0; }
EXPORT int N(ResetSlave)(void* c) { (void)c; return 0; }
EXPORT void N(FreeSlaveInstance)(void* c) { ((Slave*)c)->calls.release(c); }
#define ACCESS(Type, type, member)                                                                          \
    EXPORT int N(Get##Type)(void* c, const unsigned vr[], size_t n, type values[]) {                        \
        if (!((Slave*)c)->initialized) return 3;                                                            \
        for (size_t k = 0; k < n; k++) values[k] = ((Slave*)c)->member[vr[k]];                              \
        return 0;                                                                                           \
    }                                                                                                       \
    EXPORT int N(Set##Type)(void* c, const unsigned vr[], size_t n, const type values[]) {                  \
        for (size_t k = 0; k < n; k++) ((Slave*)c)->member[vr[k]] = values[k];                              \
        return 0;                                                                                           \
    }
ACCESS(Real, double, real)
ACCESS(Integer, int, integer)
ACCESS(Boolean, char, boolean)
EXPORT int N(GetString)(void* c, const unsigned vr[], size_t n, const char* values[]) {
    (void)vr;
    for (size_t k = 0; k < n; k++) values[k] = ((Slave*)c)->text;
    return 0;
}
EXPORT int N(SetString)(void* c, const unsigned vr[], size_t n, const char* const values[]) {
    (void)vr;
    for (size_t k = 0; k < n; k++) strncpy(((Slave*)c)->text, values[k], 199);
    return 0;
}
EXPORT int N(DoStep)(void* c, double t, double h, char fresh) {
    Slave* s = c;
    (void)fresh;
#ifdef FAULT
    if (t > 0.45) {
        s->calls.logger(s, "it", FAULT, "error", "the bearing is %s", "hot");
        return FAULT;
    }
#endif
    s->real[2] += h * s->real[1] * s->real[0], s->time = t + h;
    return 0;
}
#define UNUSED(name) EXPORT int N(name)(void* c) { (void)c; return 3; }
UNUSED(SetRealInputDerivatives)
UNUSED(GetRealOutputDerivatives)
UNUSED(CancelStep)
UNUSED(GetStatus)
UNUSED(GetRealStatus)
UNUSED(GetIntegerStatus)
UNUSED(GetBooleanStatus)
UNUSED(GetStringStatus)
