"""Results of a fit: parameters with intervals and statuses, the identifiability statement, sounds, `fit.json`.

`build_result` turns an inference into a `Result`. `predict_recording` predicts a recording that took no part in the
fit, and `cross_validate` does so for every stroke in turn.
"""

from .build_result import build_result
from .fitted_recording import FittedRecording
from .result import Result
