"""The extended Lagrangian core: coordinates, equations of motion, plants and learned models."""
