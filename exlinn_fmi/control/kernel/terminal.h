/* The terminal set, as in control/terminal.py. */
#ifndef TERMINAL_H
#define TERMINAL_H

#include "dense.h"

#define FLAT 1e-12 /* share of its diagonal that is added to P */
#define EVERYWHERE 1e300

/* Numbers that `terminal_level` needs. */
static size_t terminal_scratch(int n, int m) { return (size_t)(n * n + 2 * n * m + m * m + 2 * n + m); }

/* What the bound |rowᵀe| ≤ room allows: room² / rowᵀP⁻¹row, from the factor L of P in these units. */
static double allowed_level(int n, const double *L, const double *unit, double room, double *row) {
    double spread = 0.0;
    for (int i = 0; i < n; ++i) {
        row[i] *= unit[i];
        for (int k = 0; k < i; ++k) row[i] -= L[i * n + k] * row[k];
        row[i] /= L[i * n + i];
        spread += row[i] * row[i];
    }
    return spread > 0.0 ? smaller(room * room / spread, EVERYWHERE) : EVERYWHERE;
}

/* The largest α for which eᵀPe ≤ α keeps the feedback's inputs, and the `s` states `soft`, within their rooms. */
static double terminal_level(int n, int m, int s, const double *A, const double *B, const double *R, const double *P,
                             const double *u_room, const long long *soft, const double *x_room, double *scratch) {
    double *PB = scratch, *S = PB + n * m, *K = S + m * m, *L = K + m * n, *unit = L + n * n, *row = unit + n;
    double *column = row + n, level = EVERYWHERE;
    multiply(n, n, m, P, B, PB);
    for (int i = 0; i < m; ++i)
        for (int j = 0; j < m; ++j) {
            S[i * m + j] = R[i * m + j];
            for (int l = 0; l < n; ++l) S[i * m + j] += B[l * m + i] * PB[l * m + j];
        }
    if (!cholesky(m, S)) return 0.0;
    for (int j = 0; j < n; ++j) {
        for (int i = 0; i < m; ++i) {
            column[i] = 0.0;
            for (int l = 0; l < n; ++l) column[i] += PB[l * m + i] * A[l * n + j];
        }
        cholesky_solve(m, S, column);
        for (int i = 0; i < m; ++i) K[i * n + j] = column[i];
    }
    for (int i = 0; i < n; ++i) unit[i] = P[i * (n + 1)] > 0.0 ? 1.0 / sqrt(P[i * (n + 1)]) : 1.0;
    for (int i = 0; i < n; ++i)
        for (int j = 0; j < n; ++j) L[i * n + j] = unit[i] * P[i * n + j] * unit[j] + (i == j ? FLAT : 0.0);
    if (!cholesky(n, L)) return 0.0;
    for (int i = 0; i < m; ++i)
        level = smaller(level, allowed_level(n, L, unit, u_room[i], K + i * n));
    for (int b = 0; b < s; ++b) {
        for (int i = 0; i < n; ++i) row[i] = i == soft[b];
        level = smaller(level, allowed_level(n, L, unit, x_room[b], row));
    }
    return level;
}

#endif
