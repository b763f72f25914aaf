"""FMUs with C inside and no Python, from plant pages and learned models alike."""

from exlinn_fmi.export.build import export_plant, export_system

__all__ = ["export_plant", "export_system"]
