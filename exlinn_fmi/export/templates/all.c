/* The whole FMU in one translation unit, so that nothing but the FMI functions has a name outside.
 *
 *     cc -shared -fPIC -O2 -std=c99 -ffp-contract=off all.c -o MODEL_IDENTIFIER.so -lm
 */
#include <float.h>
#include <math.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "model.h"
#include "equations.c"
#if CONTROLLER
#include "controller.c"
#else
#include "core.c"
#endif
#if FMI == 2
#include "fmi2.c"
#else
#include "fmi3.c"
#endif
