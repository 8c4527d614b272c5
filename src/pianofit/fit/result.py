"""A fit in words and numbers: the document that becomes `fit.json` (design §6), and the two sounds it compares."""

from __future__ import annotations

import platform
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np

from .. import __version__
from ..analysis import Analysis
from ..criterion import BANDS, OutputPath, band_values, borders, closed_form_gain, level_error_db, measure
from ..initial import Start
from ..model import Simulation
from ..parameters import PARAMETERS
from ..recording import Recording
from .levenberg import descend
from .recipe import Fit, predicted
from .residuals import joint_batch
from .space import NAMES, K, split, struck
from .target import Measured
from .uncertainty import covariance, intervals, statuses, tangled, to_stiffness
from .verdict import verdict, words
from .voice import Voice

__all__ = ["SCHEMA", "Result", "Sound", "conclude"]

SCHEMA = 1
# Levels are compared over partials to 6 kHz within 60 dB of the strongest (design §4).
LEVEL_TOP, LEVEL_RANGE = 6000.0, 60.0
UNITS = {name: p.unit for name, p in PARAMETERS.items()} | {
    "x0": "m", "M_S": "kg", "L": "m", "width": "m", "pickup": "m",
}  # fmt: skip


@dataclass(frozen=True)
class Sound:
    """One set of parameters, heard."""

    voice: Voice
    samples: np.ndarray  # file units, as long as the recording
    simulation: Simulation
    level: np.ndarray  # dB, [partials], gain and path included, in the recording's unit


@dataclass(frozen=True)
class Result:
    """A finished fit. `document` is what `fit.json` holds."""

    document: dict
    initial: Sound
    fitted: Sound
    data: Measured
    recording: Recording
    analysis: Analysis

    @property
    def worse_bands(self) -> list[str]:
        """Occupied bands, and `global`, whose criterion ended no lower than it started."""
        return worse_bands(self.document["criterion"])


def worse_bands(criterion: dict) -> list[str]:
    """Occupied bands, and `global`, in which the criterion ended no lower than it started."""
    names = [n for n in ("global", *BANDS) if n in criterion]
    return [n for n in names if criterion[n]["final"] >= criterion[n]["initial"]]


def conclude(recording: Recording, analysis: Analysis, start: Start, fit: Fit, seed: int) -> Result:
    """Put a fit into words: intervals, statuses, the criterion and the levels before and after.

    Raises
    ------
    FitError
        If the initial or the final contact does not end.
    """
    scored = _scored(fit.data)
    first = fit.space.start.copy()
    first[: len(NAMES)] = [start.initial.get(n, start.values[n]) for n in NAMES]
    ear = _Ear.of(recording, analysis, fit.data)
    unit = 1.0 if start.scale is None else 1.0 / start.scale
    initial = _sound(ear, start, fit, first, unit if start.scale else None, None)
    gain, path = _gain_and_path(fit, start, fit.values)
    fitted = _sound(ear, start, fit, fit.values, gain * unit if start.scale else None, path)
    literature = None if fit.data.calibrated else _path_only(fit)
    measured = fit.data.level[: fit.data.found]

    cov = covariance(fit.jacobian, _row_variance(fit), fit.space, fit.pressed)
    cov = to_stiffness(cov, fit.values, fit.space.log_u)
    states = statuses(cov, fit.space, fit.space.at_bound(fit.values), start.fixed)
    levels = {
        "initial_db": level_error_db(initial.level[scored], measured[scored]),
        "fitted_db": level_error_db(fitted.level[scored], measured[scored]),
        "path_only_db": None if literature is None else level_error_db(literature[0][scored], measured[scored]),
        "partials": int(scored.sum()),
    }
    opening, states = verdict(fit, start, states, levels, None if literature is None else literature[1])
    spans = intervals(cov, fit.values[: len(NAMES)], max(3 * len(fit.data.partials) - int(fit.space.free.sum()), 1))
    criterion = _criterion(ear, fit.data, initial, fitted)
    document = {
        "schema": SCHEMA,
        "program": "pianofit",
        "recipe": "default",
        "seed": seed,
        "converged": fit.converged,
        "verdict": opening,
        "messages": words(fit, start, analysis, recording, states, tangled(cov), worse_bands(criterion)),
        "parameters": _parameters(fit.values, first, spans, states, start),
        "takes": [_take(recording, fit.values, fitted.voice.gain, start)],
        "pickup": {"quantity": start.quantity, "path": _path_document(path)},
        "derived": _derived(fitted, analysis, cov),
        "criterion": criterion,
        "levels": levels,
        "diagnostics": _diagnostics(fit, cov),
        "versions": versions(),
    }
    return Result(document, initial, fitted, fit.data, recording, analysis)


def versions() -> dict[str, str]:
    """Of the program and of everything the numbers depend on."""
    import jax
    import scipy

    return {
        "pianofit": __version__, "python": platform.python_version(), "jax": jax.__version__,
        "numpy": np.__version__, "scipy": scipy.__version__,
    }  # fmt: skip


def _row_variance(fit: Fit) -> np.ndarray:
    """Variance that each residual is expected to have: 1 by its weight, save for those of level and of eq. 19.

    Their weights are not their scatter's alone, which is known all the same.
    """
    rows, found = len(fit.target.row), fit.data.found
    variance = np.ones(fit.jacobian.shape[0])
    sd = np.hypot(fit.data.partials.level_error, fit.spread.level)
    variance[2 * rows : 2 * rows + found] = (np.asarray(fit.target.level_weight)[:found] * sd) ** 2
    sd = sd * np.log(10) / 10
    variance[3 * rows : 3 * rows + found] = (np.asarray(fit.target.line_weight)[:found] * sd) ** 2
    variance[3 * rows + found : 4 * rows] = 0.0
    return variance


def _scored(data: Measured) -> np.ndarray:
    """The partials on which levels are compared [partials], bool."""
    level = data.level[: data.found]
    return (data.partials.frequency <= LEVEL_TOP) & (level >= level.max() - LEVEL_RANGE)


@dataclass(frozen=True)
class _Ear:
    """The recording on the paper's criterion: cells, and what any other sound of the same length gives on them."""

    recording: Recording
    analysis: Analysis
    last: int
    sigma: float
    spacing: np.ndarray
    energy: np.ndarray

    @classmethod
    def of(cls, recording: Recording, analysis: Analysis, data: Measured) -> _Ear:
        last = int(data.partials.number.max())
        cells, energy = measure(
            recording.samples[recording.onset :], recording.rate, analysis.f0, analysis.B, last, data.sigma
        )
        return cls(recording, analysis, last, data.sigma, cells.spacing, energy)

    def hear(self, samples: np.ndarray) -> np.ndarray:
        """|Y|² [partials, nodes] of a sound aligned to the recording."""
        a, r = self.analysis, self.recording
        return measure(samples[r.onset :], r.rate, a.f0, a.B, self.last, self.sigma)[1]

    def gain(self, samples: np.ndarray) -> float:
        """The factor on `samples` that the criterion likes best."""
        return float(np.sqrt(closed_form_gain(self.hear(samples), self.energy, self.spacing[:, None])))


def _sound(ear: _Ear, start: Start, fit: Fit, values: np.ndarray, gain: float | None, path: OutputPath | None) -> Sound:
    """Play `values`; without a gain, with the one that the criterion likes best."""
    recording = ear.recording
    string, hammer = split(values)
    geometry = struck(start.geometry, values)
    voice = Voice(string, hammer, geometry, start.quantity, 1.0, path)
    touch = recording.onset - round(float(fit.target.delay) * recording.rate)
    samples, simulation = voice.play(recording.rate, len(recording.samples), touch)
    gain = ear.gain(samples) if gain is None else gain
    z = fit.space.z(values)
    if not fit.data.calibrated:
        z[len(NAMES)] = 20 * np.log10(max(gain, 1e-15))
    return Sound(voice._replace(gain=gain), samples * gain, simulation, predicted(fit.data, fit.target, fit.cfg, z)[2])


def _gain_and_path(fit: Fit, start: Start, values: np.ndarray) -> tuple[float, OutputPath | None]:
    """Gain, a factor, and path in `values` [size]."""
    gain = 10 ** (values[len(NAMES)] / 20)
    if start.quantity != "pressure":
        return float(gain), None
    order = np.argsort(fit.data.frequency)
    path = np.asarray(fit.target.basis)[: len(order), 1:] @ values[len(NAMES) + 1 :]
    return float(gain), OutputPath(fit.data.frequency[order], path[order])


def _path_only(fit: Fit) -> tuple[np.ndarray, float]:
    """Levels of the literature's hammer on the fitted string through the path that suits it best, and its χ² excess."""
    free = np.arange(len(fit.values)) >= len(NAMES)
    values = np.where(np.arange(len(fit.values)) < 4, fit.values, fit.space.start)
    values[len(NAMES)] = fit.values[len(NAMES)]
    held = replace(fit.space, free=fit.space.free & free, start=values)
    end = descend(
        lambda z: joint_batch(jnp.asarray(z), fit.target, fit.cfg), held.z(values[None]), held, iterations=25, free=free
    )
    weight = np.asarray(fit.target.level_weight)[: fit.data.found]
    measured = fit.data.level[: fit.data.found]

    def misfit(z: np.ndarray) -> tuple[np.ndarray, float]:
        level = predicted(fit.data, fit.target, fit.cfg, z)[2]
        return level, float(((weight * (level - measured)) ** 2).sum())

    level, cost = misfit(end.z[0])
    return level, cost - misfit(fit.z[0])[1]


def _parameters(values, first, spans, states, start: Start) -> dict:
    """Every parameter with value, unit, interval and status."""
    table = {}
    for i, name in enumerate(NAMES):
        rests = start.rests_on.get(name, ())
        status = "assumed" if rests and states[name] == "free" else states[name]
        note = f"rests on an assumed {' and '.join(rests)}" if rests else ""
        if name == "width" and states[name] not in ("fixed", "assumed"):
            note = "effective: of the raised cosine that acts as the felt's own window does"
        table[name] = {
            "value": float(values[i]), "unit": UNITS[name], "interval": spans[name], "status": status,
            "initial": float(first[i]), "note": note,
        }  # fmt: skip
    g = start.geometry
    for name, value, key in (("M_S", g.mass, "mass"), ("L", g.length, "length")):
        status = "assumed" if key in start.assumed else "fixed"
        table[name] = {"value": float(value), "unit": UNITS[name], "interval": None, "status": status,
                       "initial": float(value), "note": ""}  # fmt: skip
    if start.quantity in ("velocity", "displacement"):
        table["pickup"] = {"value": float(g.pickup), "unit": "m", "interval": None, "status": "fixed",
                           "initial": float(g.pickup), "note": ""}  # fmt: skip
    return table


def _take(recording: Recording, values: np.ndarray, gain: float, start: Start) -> dict:
    return {
        "file": recording.path, "sha256": recording.sha256, "rate": recording.rate,
        "onset_s": recording.onset / recording.rate, "v_H0": float(values[NAMES.index("v_H0")]),
        "gain": gain, "gain_status": "free" if start.scale is None else "fixed",
    }  # fmt: skip


def _path_document(path: OutputPath | None) -> dict | None:
    return None if path is None else {"frequency": path.frequency.tolist(), "db": path.db.tolist()}


def _derived(fitted: Sound, analysis: Analysis, cov: np.ndarray) -> dict:
    """What follows from the parameters and needs no assumed scale, and what the strike did."""
    voice, pulse = fitted.voice, fitted.simulation.pulse
    f0 = voice.string.c / (2 * voice.geometry.length)
    B = (voice.string.kappa * np.pi / (voice.string.c * voice.geometry.length)) ** 2
    u = float(pulse.compression.max())
    # The felt's force at the largest compression reached is what a strike fixes of K_H and p.
    change = np.zeros(len(NAMES))
    change[K], change[NAMES.index("p")] = 1.0, voice.hammer.p * np.log(u)
    return {
        "f0": float(f0), "B": float(B), "f1": float(f0 * np.sqrt(1 + B)),
        "M_H/M_S": float(voice.hammer.M_H / voice.geometry.mass),
        "x0/L": float(voice.geometry.strike / voice.geometry.length),
        "contact_ms": 1e3 * fitted.simulation.contact_time, "max_force_N": float(pulse.force.max()),
        "max_compression_mm": 1e3 * u,
        "felt_force_N": float(voice.hammer.K_H * u**voice.hammer.p),
        "felt_force_relative_error": float(np.sqrt(max(change @ cov @ change, 0.0))),
        "glide_cents": float(analysis.glide_cents),
        "glide": [{"start_s": a, "stop_s": b, "f0": f} for a, b, f in analysis.glide],
    }  # fmt: skip


def _criterion(ear: _Ear, data: Measured, initial: Sound, fitted: Sound) -> dict:
    """Eq. 19 per band on the sounds themselves, from the onset on; bands without a partial are dropped."""
    before = band_values(ear.hear(initial.samples), ear.energy, ear.spacing)
    after = band_values(ear.hear(fitted.samples), ear.energy, ear.spacing)
    occupied = {"global", *(BANDS[b] for b in data.occupied)}
    values = {name: {"initial": before[name], "final": after[name]} for name in before if name in occupied}
    return values | {
        "dropped": [name for name in BANDS if name not in occupied],
        "sigma": ear.sigma,
        "borders": list(borders(ear.analysis.f0, ear.analysis.B, ear.last)),
    }


def _diagnostics(fit: Fit, cov: np.ndarray) -> dict:
    return {
        "cost": fit.cost, "evaluations": fit.evaluations, "agreeing_starts": fit.agreeing,
        "partials": len(fit.data.partials), "contact_rate_Hz": float(fit.target.rate), "modes": fit.cfg.n_modes,
        "scatter": {"frequency_cents": fit.spread.frequency, "decay_relative": fit.spread.decay,
                    "level_db": fit.spread.level},
        "correlated": [{"pair": [a, b], "correlation": r} for a, b, r in tangled(cov)],
    }  # fmt: skip
