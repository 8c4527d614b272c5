"""From the minima of the search to those of F itself: with the string free, and without the contact's step error."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .problem import Problem
from .search import Population, Search, distinct
from .string import StringState, hyper_step, string_report

__all__ = ["Minima", "finished"]

# Minima whose F is higher by more than this have no share: exp(-6) is a quarter of a percent.
WITHIN = 6.0
# So many at most are finished.
MOST = 4
# The step error is read off again while it still moves the levels by this share of a standard deviation, rms.
LEFT, READINGS = 0.05, 4
ITERATIONS = 25


class Minima(NamedTuple):
    """Minima of F, the lowest first; [B, ...]."""

    search: Search  # with the string free, and the best minimum's step error
    people: Population
    F: np.ndarray  # with everything
    offsets: np.ndarray  # dB, the step error of each [B, R, K]
    strings: list[StringState]
    converged: np.ndarray


def finished(problem: Problem, found: Population, held: Search, strings: StringState) -> Minima:
    """Every distinct minimum near the lowest, finished on F with all its unknowns."""
    scores = held.total(found.z, found.report)
    begun = distinct(found, held.unknowns, scores, WITHIN)[:MOST]
    ends = [_finished(problem, found.take(np.array([i])), strings) for i in begun]
    people = ends[0][1]
    for end in ends[1:]:
        people = people.join(end[1])
    F = np.array([end[2] for end in ends])
    # Two that were distinct may have come to the same minimum: it counts once.
    kept = distinct(people, held.unknowns, F, WITHIN)
    return Minima(
        ends[kept[0]][0], people.take(np.array(kept)), F[kept], np.stack([ends[i][0].offset for i in kept]),
        [ends[i][0].strings for i in kept], np.array([ends[i][3] for i in kept]),
    )  # fmt: skip


def _finished(problem: Problem, one: Population, strings: StringState) -> tuple[Search, Population, float, bool]:
    search = Search(problem, one.z[0, :4], strings)
    settled = False
    for _ in range(READINGS):
        before = search.offset
        search.offset = search.step_error(one.z[0])
        one = search.begun(one.z, one.phi[0], one.w[0])
        one = search.descend(one, 0.0, ITERATIONS)
        settled = bool(one.gained[0] < 1.0)
        reports = string_report(problem, one.z[0, :4], search.strings)
        search.strings, _ = hyper_step(problem, one.z[0, :4], search.strings, reports)
        sd = np.sqrt(np.asarray(search.table.variance) + np.exp(2 * one.phi[0, 0]))
        moved = (search.offset - before) / sd * np.asarray(search.table.found)
        if np.sqrt((moved**2).sum() / max(np.asarray(search.table.found).sum(), 1)) < LEFT:
            break
    return search, one, float(search.total(one.z, one.report)[0]), settled
