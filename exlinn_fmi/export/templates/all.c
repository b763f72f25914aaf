/* The whole FMU in one translation unit, so that nothing but the FMI functions has a name outside.
 *
 *     cc -shared -fPIC -O2 -std=c99 -ffp-contract=off all.c -o MODEL_IDENTIFIER.so -lm
 */
#include "model.h"
#include "equations.c"
#include "core.c"
#include "fmi2_common.c"
#include "fmi2_model_exchange.c"
#include "fmi2_co_simulation.c"
