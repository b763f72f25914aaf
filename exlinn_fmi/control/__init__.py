"""Nonlinear model predictive control around a Lagrangian system: reference, OCP, solvers, controller."""
