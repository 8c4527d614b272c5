"""Candidates of a search: where each is, what F says there, and how its descent is going."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .reports import Report

__all__ = ["Population"]

# What a population has of each candidate, beside its report.
ARRAYS = ("z", "phi", "w", "residual", "jacobian", "damping", "inverse", "gained")


@dataclass
class Population:
    """Candidates on their way down: θ, φ, w, what F says there, and how each is going. [B, ...] throughout."""

    z: np.ndarray
    phi: np.ndarray
    w: np.ndarray
    residual: np.ndarray
    jacobian: np.ndarray
    report: Report
    damping: np.ndarray
    inverse: np.ndarray  # approximate inverse Hessian of F by φ [B, 4, 4]
    gained: np.ndarray

    def __len__(self) -> int:
        return len(self.z)

    def take(self, which: np.ndarray) -> Population:
        """Some of them, in this order."""
        fields = {name: getattr(self, name)[which] for name in ARRAYS}
        return Population(**fields, report=self.report.take(which))

    def put(self, which: np.ndarray, other: Population) -> None:
        """Replace some by `other`'s."""
        for name in ARRAYS:
            getattr(self, name)[which] = getattr(other, name)
        for mine, new in zip(self.report, other.report, strict=True):
            mine[which] = new

    def join(self, other: Population) -> Population:
        """Both."""
        fields = {name: np.concatenate([getattr(self, name), getattr(other, name)]) for name in ARRAYS}
        joined = Report(*(np.concatenate(pair) for pair in zip(self.report, other.report, strict=True)))
        return Population(**fields, report=joined)
