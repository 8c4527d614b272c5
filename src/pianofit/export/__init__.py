"""Export of an instrument to other programs: samplers (SFZ, Decent Sampler) and Faust."""

from .formats import SAMPLERS
from .sampler import ExportOptions, ExportSummary, export_sampler

__all__ = ["SAMPLERS", "ExportOptions", "ExportSummary", "export_sampler"]
