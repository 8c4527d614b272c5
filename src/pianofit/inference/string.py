"""The string's own minimum: c, κ, b1 and b2 by the frequencies and decays alone, before any hammer is known."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .coordinates import STRING_SIZE
from .likelihood import next_weights
from .observations import CENTS, string_law
from .problem import Problem
from .reports import Report, report

__all__ = ["StringState", "hyper_step", "residuals_of", "string_minimum", "string_report", "string_residuals"]

ITERATIONS = 40
# A minimum is reached when an iteration gains less than this.
CONVERGED = 1e-6


class StringState(NamedTuple):
    """φ [4] and w [1, K] of frequencies, then of decays."""

    phi: tuple[np.ndarray, np.ndarray]
    w: tuple[np.ndarray, np.ndarray]


def string_residuals(problem: Problem, string: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Residuals [1, K] and their laws' derivatives [1, K, 4], of frequencies, cents, and of log decays."""
    o = problem.observed
    measured = o.frequency.value[0], o.decay.value[0]
    return residuals_of(string, measured, o.string_number, o.law, float(problem.start.geometry.length))


def residuals_of(string, measured, number, law, length, xp=np):
    """As `string_residuals`, of arrays, NumPy's or JAX's."""
    value, slope = string_law(string, number, length, xp)
    laws = CENTS * xp.log(value[0] / law[0]), xp.log(value[1] / law[1])
    slopes = CENTS * slope[0], slope[1] / value[1][:, None]
    return [(y - own)[None] for y, own in zip(measured, laws, strict=True)], [s[None] for s in slopes]


def string_report(problem: Problem, string: np.ndarray, state: StringState) -> tuple[Report, Report]:
    """F of frequencies and of decays, without the prior of θ."""
    residuals, slopes = string_residuals(problem, string)
    tables = problem.observed.frequency, problem.observed.decay
    pitch, loss = (report(*each) for each in zip(tables, residuals, slopes, state.phi, state.w, strict=True))
    return pitch, loss


def string_minimum(problem: Problem) -> tuple[np.ndarray, StringState]:
    """The string at the minimum of its tables' F and its prior, and their φ and w."""
    u, o = problem.unknowns, problem.observed
    string, free = u.mean[:STRING_SIZE].copy(), u.free[:STRING_SIZE]
    tables = o.frequency, o.decay
    state = StringState(tuple(np.array(t.prior[0]) for t in tables), tuple(np.ones_like(t.value) for t in tables))  # pyright: ignore[reportArgumentType]
    weight = np.where(free, 1 / np.where(free, u.sd[:STRING_SIZE], 1.0) ** 2, 0.0)

    def total(string, reports):
        return sum(float(r.F) for r in reports) + 0.5 * (weight * (string - u.mean[:STRING_SIZE]) ** 2).sum()

    found = string_report(problem, string, state)
    F, damping = total(string, found), 1e-3
    for _ in range(ITERATIONS):
        before = F
        gradient = sum(r.gradient for r in found) + weight * (string - u.mean[:STRING_SIZE])
        curvature = sum(r.curvature for r in found) + np.diag(weight)
        lhs = np.where(np.outer(free, free), curvature + damping * np.diag(np.diag(curvature)), np.eye(STRING_SIZE))
        step = np.linalg.solve(lhs, np.where(free, -gradient, 0.0))
        moved = np.clip(string + np.clip(step, -1, 1), u.lower[:STRING_SIZE], u.upper[:STRING_SIZE])
        trial = np.where(free, moved, string)
        tried = string_report(problem, trial, state)
        if total(trial, tried) <= F:
            string, found, damping = trial, tried, max(damping / 5, 1e-9)
        else:
            damping *= 8
        state, found = hyper_step(problem, string, state, found)
        F = total(string, found)
        if abs(before - F) < CONVERGED and damping < 1:
            break
    return string, state


def hyper_step(problem: Problem, string: np.ndarray, state: StringState, found: tuple[Report, Report]):
    """One step of the excess and of w for both tables, on the same F; a step that raises it is halved."""
    tables = problem.observed.frequency, problem.observed.decay
    w = tuple(next_weights(t, r.by_log_w, x) for t, r, x in zip(tables, found, state.w, strict=True))
    steps = []
    for table, r in zip(tables, found, strict=True):
        curvature = 2 * float(table.found.sum()) + 1 / float(table.prior[1][0]) ** 2
        steps.append(np.append(np.clip(-r.by_phi[0] / (0.5 * curvature), -1.0, 1.0), np.zeros(3)))
    for share in (1.0, 0.5, 0.25, 0.1, 0.0):
        tried = StringState(tuple(p + share * s for p, s in zip(state.phi, steps, strict=True)), w)  # pyright: ignore[reportArgumentType]
        new = string_report(problem, string, tried)
        if sum(float(r.F) for r in new) <= sum(float(r.F) for r in found):
            return tried, new
    return state, found
