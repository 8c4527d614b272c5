"""Admittance of the bridge from the decays of the recorded keys.

A string loses energy to the bridge at the rate α_bridge = (T/L) Re Y, with the tension T and the length L. The strings
of a unison move the bridge together right after a stroke, so that n strings lose n α_bridge. Later they move against
each other and lose only what air and felt take. So α_bridge is the decay rate of the prompt sound minus that of the
aftersound (Weinreich, J. Acoust. Soc. Am. 62, 1474, 1977).
"""

from collections.abc import Iterable

import numpy as np

from ..conversions import HALF_WIDTH_95
from ..literature import typical_strings
from ..model.modal_response import EARLY, ModalResponse
from ..model.note import Note
from ..schema.bridge import LITERATURE, LITERATURE_SD, BridgeAdmittance

# Frequencies at which the admittance is stated: half octaves over the range of strings, Hz.
KNOTS = 31.25 * 2.0 ** (0.5 * np.arange(17))
# Standard deviation of the logarithm about its mean over frequency, and length, octaves, over which it is smooth: the
# mean value of Skudrzyk, without single resonances of the soundboard. Chosen.
SHAPE_SD, SHAPE_OCTAVES = 0.5, 1.0
# Least ratio of both rates of a partial that shows its aftersound. Chosen: with less, their difference is mostly error.
LEAST_BEND = 1.25
# Degrees of freedom of Student's t for the scatter of partials, and rounds of reweighting.
FREEDOM, ROUNDS = 4.0, 20
# Smallest scatter of the logarithm of a partial's rate: single places on the bridge differ. Chosen.
LEAST_SCATTER = 0.2


def unison_bridge_rate(note: Note, midi: int, hz: np.ndarray, bridge: BridgeAdmittance) -> np.ndarray:
    """Return the decay rate that the bridge causes when the strings of a key move together, 1/s [modes]."""
    return typical_strings(midi) * _tension_over_length(note) * bridge.at(hz)


def measure_bridge(notes: Iterable[tuple[int, Note]]) -> BridgeAdmittance:
    """Estimate the admittance from the modal responses of recorded keys, given as pairs of MIDI number and note.

    The logarithm is a Gaussian process over log frequency about the value of the literature. Keys without a modal
    response say nothing. Without any measured partial the result is the literature's.
    """
    points = [
        (hz, rate / (typical_strings(midi) * _tension_over_length(note)))
        for midi, note in notes
        if note.modal_response is not None
        for hz, rate in prompt_excess(note.modal_response)
    ]
    if not points:
        return BridgeAdmittance()
    hz, admittance = np.array(points).T
    octave, y = np.log2(hz), np.log(admittance / LITERATURE)
    own, at = _covariance(octave, octave), _covariance(np.log2(KNOTS), octave)
    scatter, weight = max(float(np.std(y)), LEAST_SCATTER), np.ones(len(y))
    mean = np.zeros(len(y))
    for _ in range(ROUNDS):
        total = own + np.diag(scatter**2 / weight)
        mean = own @ np.linalg.solve(total, y)
        scatter = max(float(np.sqrt(np.mean(weight * (y - mean) ** 2))), LEAST_SCATTER)
        weight = (FREEDOM + 1) / (FREEDOM + ((y - mean) / scatter) ** 2)
    solved = np.linalg.solve(own + np.diag(scatter**2 / weight), at.T)
    log_value = np.log(LITERATURE) + solved.T @ y
    variance = np.diag(_covariance(np.log2(KNOTS), np.log2(KNOTS))) - np.sum(at * solved.T, axis=1)
    half = HALF_WIDTH_95 * np.sqrt(np.maximum(variance, 0.0))
    columns = (KNOTS, np.exp(log_value), np.exp(log_value - half), np.exp(log_value + half))
    at_knots, value, low, high = (tuple(map(float, column)) for column in columns)
    return BridgeAdmittance(at_knots, value, low, high, "recordings", len(points))


def prompt_excess(response: ModalResponse) -> list[tuple[float, float]]:
    """Return frequency, Hz, and decay rate of the prompt sound minus that of the aftersound, 1/s, of partials.

    The prompt rate is the mean over the modes of a partial, weighted with their energies at the begin of the early
    decay, because modes that die before it belong to the attack. It has no interference, so beats do not count as
    decay. The aftersound decays as the slowest mode. Partials whose decay hardly bends are left out: they do not show
    their aftersound.
    """
    found = []
    for number in np.unique(response.partial):
        chosen = response.partial == number
        rate, hz = -np.real(response.pole[chosen]), np.imag(response.pole[chosen]) / (2 * np.pi)
        energy = np.sum(np.abs(response.pattern[:, chosen]) ** 2, axis=0) * np.exp(-2 * rate * EARLY[0])
        if energy.sum() > 0 and (prompt := float(energy @ rate / energy.sum())) > LEAST_BEND * rate.min():
            found.append((float(energy @ hz / energy.sum()), prompt - float(rate.min())))
    return found


def _tension_over_length(note: Note) -> float:
    """T/L of one string, kg/s²."""
    return float(note.geometry.mass * (note.string.c / note.geometry.length) ** 2)


def _covariance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Prior covariance of the logarithm, relative to the literature, between octaves."""
    return LITERATURE_SD**2 + SHAPE_SD**2 * np.exp(-0.5 * ((a[:, None] - b) / SHAPE_OCTAVES) ** 2)
