/* Small dense matrices, row by row, and the discrete algebraic Riccati equation. */
#ifndef DENSE_H
#define DENSE_H

#include <math.h>
#include <string.h>

static inline double larger(double a, double b) { return a > b ? a : b; }
static inline double smaller(double a, double b) { return a < b ? a : b; }

static int all_finite(const double *a, int count) {
    double sum = 0.0;
    for (int i = 0; i < count; ++i) sum += a[i] * 0.0;
    return sum == 0.0;
}

static double largest(const double *a, int count) {
    double found = 0.0;
    for (int i = 0; i < count; ++i) found = larger(found, fabs(a[i]));
    return found;
}

/* C (rows, columns) = A (rows, inner) B (inner, columns) */
static inline void multiply(int rows, int inner, int columns, const double *A, const double *B, double *C) {
    for (int i = 0; i < rows; ++i)
        for (int j = 0; j < columns; ++j) {
            double sum = 0.0;
            for (int k = 0; k < inner; ++k) sum += A[i * inner + k] * B[k * columns + j];
            C[i * columns + j] = sum;
        }
}

static void transpose(int rows, int columns, const double *A, double *T) {
    for (int i = 0; i < rows; ++i)
        for (int j = 0; j < columns; ++j) T[j * rows + i] = A[i * columns + j];
}

static void symmetrise(int n, double *A) {
    for (int i = 0; i < n; ++i)
        for (int j = 0; j < i; ++j) A[i * n + j] = A[j * n + i] = 0.5 * (A[i * n + j] + A[j * n + i]);
}

/* Cholesky factor in place, below the diagonal and on it; 0 where A is not positive definite. */
static inline int cholesky(int n, double *A) {
    for (int j = 0; j < n; ++j) {
        double d = A[j * n + j];
        for (int k = 0; k < j; ++k) d -= A[j * n + k] * A[j * n + k];
        if (!(d > 0.0)) return 0;
        d = sqrt(d);
        A[j * n + j] = d;
        for (int i = j + 1; i < n; ++i) {
            double sum = A[i * n + j];
            for (int k = 0; k < j; ++k) sum -= A[i * n + k] * A[j * n + k];
            A[i * n + j] = sum / d;
        }
    }
    return 1;
}

static inline void cholesky_solve(int n, const double *L, double *b) {
    for (int i = 0; i < n; ++i) {
        for (int k = 0; k < i; ++k) b[i] -= L[i * n + k] * b[k];
        b[i] /= L[i * n + i];
    }
    for (int i = n - 1; i >= 0; --i) {
        for (int k = i + 1; k < n; ++k) b[i] -= L[k * n + i] * b[k];
        b[i] /= L[i * n + i];
    }
}

/* A⁻¹ by elimination with row exchanges, A is destroyed; 0 where it is singular. */
static int invert(int n, double *A, double *inverse) {
    for (int i = 0; i < n * n; ++i) inverse[i] = i % (n + 1) == 0;
    for (int j = 0; j < n; ++j) {
        int pivot = j;
        for (int i = j + 1; i < n; ++i)
            if (fabs(A[i * n + j]) > fabs(A[pivot * n + j])) pivot = i;
        if (!(fabs(A[pivot * n + j]) > 0.0)) return 0;
        for (int k = 0; k < n; ++k) {
            double a = A[j * n + k], b = inverse[j * n + k];
            A[j * n + k] = A[pivot * n + k], A[pivot * n + k] = a;
            inverse[j * n + k] = inverse[pivot * n + k], inverse[pivot * n + k] = b;
        }
        double by = 1.0 / A[j * n + j];
        for (int k = 0; k < n; ++k) A[j * n + k] *= by, inverse[j * n + k] *= by;
        for (int i = 0; i < n; ++i) {
            double factor = A[i * n + j];
            if (i == j || factor == 0.0) continue;
            for (int k = 0; k < n; ++k) {
                A[i * n + k] -= factor * A[j * n + k];
                inverse[i * n + k] -= factor * inverse[j * n + k];
            }
        }
    }
    return 1;
}

/* Numbers that `solve_dare` needs. */
static size_t dare_scratch(int n, int m) { return (size_t)(9 * n * n + 2 * m * m + 2 * n * m); }

/* The stabilising P of the discrete algebraic Riccati equation by structured doubling, as in control/riccati.py.
 *
 * A (n, n) is destroyed. Returns 0 where the iteration does not converge, as for a mode that no input reaches.
 */
static int solve_dare(int n, int m, double *A, const double *B, const double *Q, const double *R, double *P,
                      double *scratch) {
    const int size = n * n;
    double *G = scratch, *W = G + size, *AW = W + size, *X = AW + size, *Y = X + size, *T = Y + size;
    double *next = T + size, *copy = next + size, *Ri = copy + size, *Rc = Ri + m * m, *BR = Rc + m * m;
    double *Bt = BR + n * m;
    memcpy(Rc, R, sizeof(double) * (size_t)(m * m));
    if (!invert(m, Rc, Ri)) return 0;
    multiply(n, m, m, B, Ri, BR);
    transpose(n, m, B, Bt);
    multiply(n, m, n, BR, Bt, G);
    memcpy(P, Q, sizeof(double) * (size_t)size);
    for (int iteration = 0; iteration < 60; ++iteration) {
        multiply(n, n, n, G, P, X);
        for (int i = 0; i < n; ++i) X[i * n + i] += 1.0;
        if (!invert(n, X, W)) return 0;
        multiply(n, n, n, A, W, AW);
        transpose(n, n, A, T);
        multiply(n, n, n, P, W, X);
        multiply(n, n, n, X, A, Y);
        multiply(n, n, n, T, Y, next); /* Aᵀ P W A */
        multiply(n, n, n, AW, G, X);
        multiply(n, n, n, X, T, Y);
        for (int i = 0; i < size; ++i) next[i] += P[i], G[i] += Y[i];
        multiply(n, n, n, AW, A, X);
        memcpy(A, X, sizeof(double) * (size_t)size);
        double change = 0.0;
        for (int i = 0; i < size; ++i) change = larger(change, fabs(next[i] - P[i]));
        memcpy(P, next, sizeof(double) * (size_t)size);
        symmetrise(n, P), symmetrise(n, G);
        if (!all_finite(P, size)) return 0;
        double scale = largest(P, size);
        if (change <= 1e-13 * scale) { /* and not below zero */
            memcpy(copy, P, sizeof(double) * (size_t)size);
            for (int i = 0; i < n; ++i) copy[i * n + i] += 1e-9 * scale + 1e-300;
            return cholesky(n, copy);
        }
    }
    return 0;
}

#endif
