"""From a run folder to figures, metrics and one self-contained report."""
