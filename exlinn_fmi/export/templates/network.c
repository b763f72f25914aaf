/* A network of fully connected layers in plain loops, its weights as data: value, slopes, and how both change.
 *
 * A layer's weights lie input by input, so that the innermost loop runs over units that do not depend on each other.
 * Values travel through the layers in channels: the value itself, its slope with each feature and, where a direction is
 * given, the change of each slope along it.
 */
enum { CHANNELS = 1 + 2 * N_FEATURES };

#if ACTIVATION_TANH
#define ACTIVATE(x) tanh(x)
#define FIRST_SLOPE(y) (1.0 - (y) * (y))
#define SECOND_SLOPE(y, slope) (-2.0 * (y) * (slope))
#else /* ReLU */
#define ACTIVATE(x) ((x) > 0.0 ? (x) : 0.0)
#define FIRST_SLOPE(y) ((y) > 0.0 ? 1.0 : 0.0)
#define SECOND_SLOPE(y, slope) (0.0 * (y) * (slope))
#endif

static void layer(const double *weight, const double *bias, int n_in, int n_out, int channels, const double *restrict in,
                  double *restrict out)
{
    memset(out, 0, (size_t)(channels * n_out) * sizeof *out);
    if (bias) {
        memcpy(out, bias, (size_t)n_out * sizeof *out);
    }
    for (int j = 0; j < n_in; j++) {
        for (int c = 0; c < channels; c++) {
            const double factor = in[c * n_in + j], *row = weight + j * n_out;
            double *sum = out + c * n_out;
            for (int i = 0; i < n_out; i++) {
                sum[i] += factor * row[i];
            }
        }
    }
}

static void activate(double *units, int n, const double *direction)
{
    for (int i = 0; i < n; i++) {
        const double y = ACTIVATE(units[i]), first = FIRST_SLOPE(y);
        double moved = 0.0;
        for (int k = 1; direction && k <= N_FEATURES; k++) {
            moved += units[k * n + i] * direction[k - 1];
        }
        for (int k = 1; k <= N_FEATURES; k++) {
            double *slope = &units[k * n + i];
            if (direction) {
                double *change = &units[(N_FEATURES + k) * n + i];
                *change = SECOND_SLOPE(y, first) * moved * *slope + first * *change;
            }
            *slope *= first;
        }
        units[i] = y;
    }
}

/* `result` is the outputs and then, feature by feature, their slopes with it; `change` is how `result` moves as the
 * features move along `direction`, if there is one. */
static void network_value(const double *features, const double *direction, double *result, double *change)
{
    const int channels = direction ? CHANNELS : 1 + N_FEATURES;
    double a[CHANNELS * MAX_WIDTH] = {0}, b[CHANNELS * MAX_WIDTH], out[CHANNELS * N_OUTPUTS];
    double *in = a, *next = b;

    memcpy(in, features, N_FEATURES * sizeof *in);
    for (int k = 0; k < N_FEATURES; k++) {
        in[(1 + k) * N_FEATURES + k] = 1.0;
    }
    for (int l = 0; l < N_LAYERS; l++) {
        layer(WEIGHT[l], BIAS[l], WIDTH[l], WIDTH[l + 1], channels, in, next);
        activate(next, WIDTH[l + 1], direction);
        double *swap = in;
        in = next;
        next = swap;
    }
    layer(WEIGHT[N_LAYERS], NULL, WIDTH[N_LAYERS], N_OUTPUTS, channels, in, out);
    memcpy(result, out, N_NETWORK * sizeof *result);
    for (int o = 0; direction && o < N_OUTPUTS; o++) {
        change[o] = 0.0;
        for (int k = 0; k < N_FEATURES; k++) {
            change[o] += out[(1 + k) * N_OUTPUTS + o] * direction[k];
            change[(1 + k) * N_OUTPUTS + o] = out[(1 + N_FEATURES + k) * N_OUTPUTS + o];
        }
    }
}
