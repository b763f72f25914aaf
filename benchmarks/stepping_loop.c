/* A co-simulation loop as one would write it in C, for `stepping.py` to compare with: FMI 2.0, values passed on,
   all outputs recorded, statuses heeded. */

#include <stddef.h>
#include <string.h>

typedef int (*Access)(void*, const unsigned*, size_t, double*);
typedef int (*Step)(void*, double, double, int);

/* Set some inputs of an FMU to values of the signal vector, then get some outputs. */
typedef struct {
    void* fmu;
    Access set, get;
    const unsigned *inputs, *outputs;
    const size_t* sources;
    size_t input_count, output_count;
    double *given, *taken;
} Visit;

int run(size_t visits, const Visit* visit, size_t fmus, void* const* fmu, const Step* step, size_t steps, double start,
        double h, size_t columns, const size_t* column, double* signals, double* table) {
    for (size_t k = 0;; k++) {
        double t = start + k * h;
        signals[0] = t;
        for (size_t v = 0; v < visits; v++) {
            const Visit* x = visit + v;
            if (x->input_count) {
                for (size_t i = 0; i < x->input_count; i++) x->given[i] = signals[x->sources[i]];
                if (x->set(x->fmu, x->inputs, x->input_count, x->given) > 1) return 1;
            }
            if (x->output_count && x->get(x->fmu, x->outputs, x->output_count, x->taken) > 1) return 1;
        }
        for (size_t c = 0; c < columns; c++) table[k * columns + c] = signals[column[c]];
        if (k == steps) return 0;
        for (size_t f = 0; f < fmus; f++)
            if (step[f](fmu[f], t, h, 1) > 1) return 1;
    }
}
