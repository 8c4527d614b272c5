"""How far a model's sound is from a recording: the paper's energy criterion in bands, and the levels of partials."""

from .bands import BANDS, WIDEST_SIGMA, Cells, band_of, borders, cell_grid, line_sigma, partial_frequency
from .energy import band_values, closed_form_gain, measure
from .levels import level_error_db

__all__ = [
    "BANDS",
    "WIDEST_SIGMA",
    "Cells",
    "band_of",
    "band_values",
    "borders",
    "cell_grid",
    "closed_form_gain",
    "level_error_db",
    "line_sigma",
    "measure",
    "partial_frequency",
]
