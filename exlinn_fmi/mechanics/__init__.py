"""The extended Lagrangian core: coordinates, Euler–Lagrange equations, plants and learned models as systems."""
