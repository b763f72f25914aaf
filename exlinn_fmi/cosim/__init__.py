"""The co-simulation master: graph, algorithms, recorder. It knows components.base and nothing else."""
