/* What a step costs, for `export.py`: the whole FMU and this in one file, so that nothing is between them.
 *
 *     cc -O3 … -I sources export_step.c -lm && ./a.out STEPS
 */
#include "all.c"

#include <time.h>

static void no_log(fmi2ComponentEnvironment e, fmi2String i, fmi2Status s, fmi2String c, fmi2String m, ...)
{
    (void)e, (void)i, (void)s, (void)c, (void)m;
}

int main(int count, char **arguments)
{
    const long steps = count > 1 ? atol(arguments[1]) : 1000;
    const fmi2CallbackFunctions importer = {no_log, NULL, NULL, NULL, NULL};
    fmi2Component c = fmi2Instantiate("timed", fmi2CoSimulation, MODEL_TOKEN, NULL, &importer, 0, 0);
    const double h = START[SOLVER_STEP];
    double best = INFINITY;

    for (int run = 0; run < 5; run++) {
        fmi2Reset(c);
        fmi2SetupExperiment(c, 0, 0, 0.0, 0, 0.0);
        fmi2EnterInitializationMode(c);
        fmi2ExitInitializationMode(c);
        const clock_t begin = clock();
        for (long k = 0; k < steps; k++) {
            if (fmi2DoStep(c, (double)k * h, h, fmi2True) != fmi2OK) {
                return 1;
            }
        }
        best = fmin(best, (double)(clock() - begin) / CLOCKS_PER_SEC);
    }
    printf("%.9g\n", 1e6 * best / (double)steps);
    fmi2FreeInstance(c);
    return 0;
}
