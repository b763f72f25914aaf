"""Physics-faithful learned models, nonlinear MPC and co-simulation for plants given as FMUs or measurements."""
