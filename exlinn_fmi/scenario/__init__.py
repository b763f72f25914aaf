"""Scenario files: their vocabulary (schema.py) and how they are read and checked (load.py)."""
