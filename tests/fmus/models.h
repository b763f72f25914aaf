/* Small models with known solutions, behaving as the Modelica Association's reference FMUs of the same names do.

   A model has reals r[] and integers i[] by value reference; r[0] is the time. MODEL chooses one. */

#include <float.h>
#include <math.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define BALL 1
#define STAIR 2
#define POL 3
#define DAHLQUIST 4
#define RESOURCE 5
#define SWITCH 6

typedef struct {
    double r[10];
    int32_t i[2];
    double next;            /* next time event, INFINITY where there is none */
    bool terminate, moved;  /* what the last event brought */
} Values;

#if MODEL == BALL
enum { TIME, HEIGHT, DER_H, V, DER_V, G, E, V_MIN };
#define NX 2
#define NZ 1
static const int STATE[] = {HEIGHT, V}, RATE[] = {DER_H, DER_V};
static void defaults(Values* m) { m->r[HEIGHT] = 1, m->r[G] = -9.81, m->r[E] = 0.7, m->r[V_MIN] = 0.1; }
static void calculate(Values* m) { m->r[DER_H] = m->r[V], m->r[DER_V] = m->r[G]; }
static void indicators(const Values* m, double z[]) { z[0] = m->r[HEIGHT] == 0 && m->r[V] == 0 ? 1 : m->r[HEIGHT]; }
static void event(Values* m) {
    if (m->r[HEIGHT] > 0 || m->r[V] >= 0) return;
    m->r[HEIGHT] = DBL_MIN, m->r[V] *= -m->r[E], m->moved = true;
    if (m->r[V] < m->r[V_MIN]) m->r[V] = 0, m->r[G] = 0;  /* it rests */
}
#elif MODEL == STAIR
#define NX 0
#define NZ 0
static const int STATE[1], RATE[1];
static void defaults(Values* m) { m->i[0] = 1, m->next = 1; }
static void calculate(Values* m) { (void)m; }
static void indicators(const Values* m, double z[]) { (void)m; (void)z; }
static void event(Values* m) {
    if (m->r[0] < m->next - 1e-12) return;
    m->i[0]++, m->next += 1;
    m->terminate = m->i[0] >= 10;
}
#elif MODEL == POL
enum { TIME, X0, DER_X0, X1, DER_X1, MU };
#define NX 2
#define NZ 0
static const int STATE[] = {X0, X1}, RATE[] = {DER_X0, DER_X1};
static void defaults(Values* m) { m->r[X0] = 2, m->r[MU] = 1; }
static void calculate(Values* m) {
    m->r[DER_X0] = m->r[X1];
    m->r[DER_X1] = m->r[MU] * ((1 - m->r[X0] * m->r[X0]) * m->r[X1]) - m->r[X0];
}
#define JACOBIAN
static double jacobian(const Values* m, int unknown, int known) {
    if (unknown == DER_X0) return known == X1;
    return known == X0 ? -2 * m->r[MU] * m->r[X0] * m->r[X1] - 1 : m->r[MU] * (1 - m->r[X0] * m->r[X0]);
}
static void indicators(const Values* m, double z[]) { (void)m; (void)z; }
static void event(Values* m) { (void)m; }
#elif MODEL == DAHLQUIST
enum { TIME, X, DER_X, K };
#define NX 1
#define NZ 0
static const int STATE[] = {X}, RATE[] = {DER_X};
static void defaults(Values* m) { m->r[X] = 1, m->r[K] = 1; }
static void calculate(Values* m) { m->r[DER_X] = -m->r[K] * m->r[X]; }
static void indicators(const Values* m, double z[]) { (void)m; (void)z; }
static void event(Values* m) { (void)m; }
#elif MODEL == RESOURCE
#define NX 0
#define NZ 0
#define RESOURCES
static const int STATE[1], RATE[1];
static void defaults(Values* m) { (void)m; }
static bool load(Values* m, const char* folder) {
    char path[4096];
    snprintf(path, sizeof path, "%s%sy.txt", folder, folder[strlen(folder) - 1] == '/' ? "" : "/");
    FILE* file = fopen(path, "r");
    if (!file) return false;
    m->i[0] = fgetc(file);
    fclose(file);
    return true;
}
static void calculate(Values* m) { (void)m; }
static void indicators(const Values* m, double z[]) { (void)m; (void)z; }
static void event(Values* m) { (void)m; }
#elif MODEL == SWITCH
/* A heater with hysteresis about a set point, a continuous input as disturbance and a discrete one as offset:
   dx/dt = heat · on + load − x, on above set + offset + band, off below. The step asks for an event at x > 90. */
enum { TIME, X, DER_X, SET, BAND, LOAD, OFFSET, HEAT };
#define NX 1
#define NZ 2
#define DISCRETE(vr) ((vr) == OFFSET)
static const int STATE[] = {X}, RATE[] = {DER_X};
static void defaults(Values* m) { m->r[SET] = 1, m->r[BAND] = 0.1, m->r[HEAT] = 3, m->i[0] = 1; }
static void calculate(Values* m) { m->r[DER_X] = m->r[HEAT] * m->i[0] + m->r[LOAD] - m->r[X]; }
static void indicators(const Values* m, double z[]) {
    double middle = m->r[SET] + m->r[OFFSET];
    z[0] = m->r[X] - middle - m->r[BAND], z[1] = m->r[X] - middle + m->r[BAND];
}
static void event(Values* m) {
    double z[2];
    indicators(m, z);
    if (m->i[0] && z[0] > 0) m->i[0] = 0, m->i[1]++;
    if (!m->i[0] && z[1] <= 0) m->i[0] = 1, m->i[1]++;
}
#endif
#ifndef DISCRETE
#define DISCRETE(vr) false
#endif

/* One step of Euler's method, which Co-Simulation takes. */
static void euler(Values* m, double h) {
    calculate(m);
    for (int k = 0; k < NX; k++) m->r[STATE[k]] += h * m->r[RATE[k]];
    m->r[0] += h;
}
