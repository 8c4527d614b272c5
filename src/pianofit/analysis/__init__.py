"""Measures a recorded note without a hammer model: partials, inharmonicity, losses and glide."""

from .analyse import analyse, check_analyses
from .analysis_result import COLUMNS, Analysis, Partials, analysis_to_dict, partial_rows
from .inharmonicity import law_frequency, tension_share
from .note_names import SAME_KEY_CENTS, cents_above, hz_to_note, nearest_note
from .warnings import beating_warning, count_beating
