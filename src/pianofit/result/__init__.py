"""What a fit says: sounds, numbers with intervals and statuses, sentences, `fit.json`; and what it foretells.

`conclude` puts what was inferred into a `Result`. `predict` plays a fit at a velocity that it was not fitted to,
`crossval` leaves strokes out for that.
"""

from __future__ import annotations

from .build_result import build_result
from .quantities import Covariance, Quantities, Quantity
from .result import FittedRecording, RenderedFit, Result

__all__ = ["Covariance", "FittedRecording", "Quantities", "Quantity", "Result", "RenderedFit", "build_result"]
