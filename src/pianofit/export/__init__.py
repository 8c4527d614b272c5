"""Export of an instrument to other programs: samplers (SFZ, Decent Sampler) and Faust."""

from .formats import SAMPLERS
from .sampler import ExportSummary, export_sampler
from .samples import ExportOptions
