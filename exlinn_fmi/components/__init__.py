"""Components: everything that the master steps, behind one FMU-like contract (base.py)."""
