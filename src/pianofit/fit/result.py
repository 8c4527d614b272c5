"""A fit in words and numbers: the document that becomes `fit.json` (design §6), and the two sounds it compares."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np

from .. import __version__
from ..analysis import Analysis
from ..criterion import BANDS, OutputPath, band_values, borders, closed_form_gain, level_error_db, measure
from ..initial import Start
from ..model import Simulation
from ..parameters import MEMORY_NAMES, PARAMETERS
from ..recording import Recording
from .certainty import Certainty, assess
from .joint import Fit
from .levenberg import descend
from .path import path_document, path_of, roughness
from .residuals import CENT, joint_batch
from .space import ABSENT, LOG, NAMES, K, split, struck
from .state import ROUGHER, predicted
from .takes import Take
from .target import Measured
from .uncertainty import statuses, tangled
from .verdict import verdict, words
from .voice import Voice, strike_voice, touched

__all__ = ["SCHEMA", "Heard", "Result", "Sound", "conclude", "scored"]

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
class Heard:
    """One take beside what the model makes of it."""

    initial: Sound
    fitted: Sound
    data: Measured
    recording: Recording
    analysis: Analysis
    criterion: dict
    levels: dict


@dataclass(frozen=True)
class Result:
    """A finished fit. `document` is what `fit.json` holds, `takes` are in the order in which they were given.

    What a page shows of one take is that of the `first`, on which the others' velocities rest. `covariance` is that of
    log(parameter) in the order of `space.NAMES`; zero for what was not fitted. `draws` are the posterior's, where
    it was asked for: values [chains, draws] by name.
    """

    document: dict
    takes: tuple[Heard, ...]
    first: int
    covariance: np.ndarray
    draws: dict[str, np.ndarray] | None = None

    @property
    def initial(self) -> Sound:
        """Before the fit, first take."""
        return self.takes[self.first].initial

    @property
    def fitted(self) -> Sound:
        """After the fit, first take."""
        return self.takes[self.first].fitted

    @property
    def data(self) -> Measured:
        """The partials, first take."""
        return self.takes[self.first].data

    @property
    def recording(self) -> Recording:
        """As it was read, first take."""
        return self.takes[self.first].recording

    @property
    def analysis(self) -> Analysis:
        """Of the first take."""
        return self.takes[self.first].analysis

    @property
    def worse_bands(self) -> list[str]:
        """Occupied bands, and `global`, whose criterion ended no lower than it started."""
        return worse_bands(self.document["criterion"])


def worse_bands(criterion: dict) -> list[str]:
    """Occupied bands, and `global`, in which the criterion ended no lower than it started."""
    names = [n for n in ("global", *BANDS) if n in criterion]
    return [n for n in names if criterion[n]["final"] >= criterion[n]["initial"]]


def conclude(
    takes: Sequence[Take], start: Start, fit: Fit, seed: int, order: Sequence[int] = (0,), sure: Certainty | None = None
) -> Result:
    """Put a fit into words: intervals, statuses, the criterion and the levels before and after.

    Parameters
    ----------
    order : where each take stands in what was given.
    sure : how sure it is; by the curvature if not given.

    Raises
    ------
    FitError
        If an initial or a final contact does not end.
    """
    first = fit.space.start.copy()
    given = np.array([start.initial.get(n, start.values[n]) for n in NAMES])
    first[:LOG] = np.where(first[:LOG] > ABSENT, given, ABSENT)
    literature = None if fit.data.calibrated else _path_only(fit)
    heard = [_heard(i, take, start, fit, first, literature) for i, take in enumerate(takes)]
    sure = sure or assess(fit)
    cov = sure.cov
    states = statuses(sure.variances, fit.space, fit.space.at_bound(fit.values), start.fixed)
    levels = _together([h.levels for h in heard])
    opening, states = verdict(fit, start, states, levels, None if literature is None else literature[1])
    criterion, fitted = heard[0].criterion, heard[0].fitted
    analyses, recordings = [t.analysis for t in takes], [t.recording for t in takes]
    said = words(fit, start, analyses, recordings, states, tangled(cov), worse_bands(criterion), sure)
    document = {
        "schema": SCHEMA,
        "program": "pianofit",
        "recipe": "default",
        "felt": start.felt,
        "seed": seed,
        "converged": fit.converged,
        "verdict": opening,
        "messages": said,
        "parameters": _parameters(fit.values, first, sure, states, start),
        "takes": _in_order([_take(fit, i, h, start, sure) for i, h in enumerate(heard)], order),
        "pickup": {"quantity": start.quantity, "path": path_document(fitted.voice.path)},
        "derived": _derived(fitted, analyses[0], cov),
        "criterion": criterion,
        "levels": levels,
        "diagnostics": _diagnostics(fit, cov) | sure.diagnostics,
        "versions": versions(),
    }
    return Result(document, tuple(_in_order(heard, order)), order[0], cov, sure.draws)


def _in_order(items: list, order: Sequence[int]) -> list:
    """Items of the takes as the fit has them, in the order in which they were given."""
    return [items[list(order).index(i)] for i in range(len(items))]


def _together(levels: list[dict]) -> dict:
    """Level errors over all takes, dB rms, and the partials counted."""
    count = np.array([x["partials"] for x in levels])

    def rms(name: str) -> float | None:
        values = [x[name] for x in levels]
        return None if None in values else float(np.sqrt((np.square(values) * count).sum() / count.sum()))

    return {name: rms(name) for name in ("initial_db", "fitted_db", "path_only_db")} | {"partials": int(count.sum())}


def _heard(i: int, take: Take, start: Start, fit: Fit, first: np.ndarray, literature) -> Heard:
    """One take before and after, on the criterion and in its levels."""
    data = fit.data.each[i]
    ear = _Ear.of(take.recording, take.analysis, data)
    unit = None if start.scale is None else 1.0 / start.scale
    initial = _sound(ear, start, fit, i, first, unit, None)
    fitted = _sound(ear, start, fit, i, fit.values, unit, path_of(fit, i, start))
    measured = data.level[: data.found]
    chosen = scored(data.partials.frequency, measured)
    through = None if literature is None else literature[0][i, data.partials.number - 1]
    of = {"initial_db": initial.level, "fitted_db": fitted.level, "path_only_db": through}
    levels = {n: None if x is None else level_error_db(x[chosen], measured[chosen]) for n, x in of.items()}
    criterion = _criterion(ear, data, initial, fitted)
    return Heard(
        initial, fitted, data, take.recording, take.analysis, criterion, levels | {"partials": int(chosen.sum())}
    )


def versions() -> dict[str, str]:
    """Of the program and of everything the numbers depend on."""
    import jax
    import scipy

    return {
        "pianofit": __version__, "python": platform.python_version(), "jax": jax.__version__,
        "numpy": np.__version__, "scipy": scipy.__version__,
    }  # fmt: skip


def scored(frequency: np.ndarray, level: np.ndarray) -> np.ndarray:
    """The partials on which levels are compared [partials], bool."""
    return (frequency <= LEVEL_TOP) & (level >= level.max() - LEVEL_RANGE)


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


def _sound(
    ear: _Ear, start: Start, fit: Fit, take: int, values: np.ndarray, gain: float | None, path: OutputPath | None
) -> Sound:
    """Play `values` as in one take; without a gain, with the one that the criterion likes best."""
    recording, layout = ear.recording, fit.data.layout
    string, hammer = split(values)
    hammer = hammer._replace(v_H0=hammer.v_H0 * float(np.exp(values[layout.ratio[take]])))
    string = string._replace(c=string.c * (1 + CENT * float(values[layout.cents[take]])))
    geometry = struck(start.geometry, values)
    voice = Voice(string, hammer, geometry, start.quantity, 1.0, path)
    simulation = strike_voice(voice, recording.rate)
    if fit.data.calibrated:
        # Laid on the recorded attack; without a scale only the onsets can be compared.
        begins = recording.onset - round(float(fit.state.delay[take]) * recording.rate)
    else:
        begins = touched(voice, simulation, recording)
    samples = voice.heard(simulation, recording.rate, len(recording.samples), begins)
    gain = ear.gain(samples) if gain is None else gain
    z = fit.space.z(values)
    if not fit.data.calibrated:
        z[layout.gain[take]] = 20 * np.log10(max(gain, 1e-15))
    data = fit.data.each[take]
    level = predicted(fit.target, fit.cfg, z)[take, 2, data.partials.number - 1]
    if path is not None:
        level = level + roughness(fit, take)[data.partials.number - 1]
    return Sound(voice._replace(gain=gain), samples * gain, simulation, level)


def _path_only(fit: Fit) -> tuple[np.ndarray, float]:
    """The literature's hammer on the fitted string through its best path: levels [takes, rows], and its χ² excess."""
    layout, index = fit.data.layout, np.arange(len(fit.values))
    free = (index >= len(NAMES)) & ~np.isin(index, layout.ratio)
    values = np.where(index < 4, fit.values, fit.space.start)
    values[layout.gain] = fit.values[layout.gain]
    held = replace(fit.space, free=fit.space.free & free, start=values)
    end = descend(
        lambda z: joint_batch(jnp.asarray(z), fit.target, fit.cfg), held.z(values[None]), held, iterations=25, free=free
    )
    cells = fit.data.found.size
    excess = (end.residual[0] ** 2 - fit.residual**2)[2 * cells : 3 * cells].sum()
    return predicted(fit.target, fit.cfg, end.z[0])[:, 2], float(excess)


def _parameters(values, first, sure: Certainty, states, start: Start) -> dict:
    """Every parameter with value, unit, interval and status."""
    table = {}
    for i, name in enumerate(NAMES):
        absent = values[i] <= ABSENT
        if absent and name in MEMORY_NAMES:
            continue
        rests = start.rests_on.get(name, ())
        status = "assumed" if rests and states[name] == "free" else states[name]
        note = f"rests on an assumed {' and '.join(rests)}" if rests else ""
        if name == "width" and states[name] not in ("fixed", "assumed"):
            note = "effective: of the raised cosine that acts as the felt's own window does"
        value, initial = float(values[i]), float(first[i])
        if absent:
            value, initial, note = 0.0, 0.0, f"the felt's law, {start.felt}, has none"
        table[name] = {
            "value": value, "unit": UNITS[name], "interval": sure.spans[name], "interval_by": sure.by[name],
            "interval_open": list(sure.open.get(name, ())), "status": status, "initial": initial, "note": note,
        }  # fmt: skip
    g = start.geometry
    for name, value, key in (("M_S", g.mass, "mass"), ("L", g.length, "length")):
        status = "assumed" if key in start.assumed else "fixed"
        table[name] = _given(value, name, status)
    if start.quantity in ("velocity", "displacement"):
        table["pickup"] = _given(g.pickup, "pickup", "fixed")
    return table


def _given(value: float, name: str, status: str) -> dict:
    """What no fit searches."""
    return {
        "value": float(value), "unit": UNITS[name], "interval": None, "interval_by": None, "interval_open": [],
        "status": status, "initial": float(value), "note": "",
    }  # fmt: skip


def _take(fit: Fit, i: int, heard: Heard, start: Start, sure: Certainty) -> dict:
    """What one take has of its own; a velocity that rests on the fastest's has the interval of their ratio."""
    recording, layout = heard.recording, fit.data.layout
    rests = start.fixed.get("v_H0") == "assumed"
    log_v = np.zeros(layout.size)
    log_v[[NAMES.index("v_H0"), layout.ratio[i]]] += 1.0
    log_v[layout.ratio[np.argmax(fit.values[layout.ratio])]] -= float(rests)
    sd = float(np.sqrt(log_v @ sure.covariance @ log_v))
    reach, v = float(sure.reach[layout.ratio[i]]) * sd, float(heard.fitted.voice.hammer.v_H0)
    known = layout.strikes[i] > 0 and not fit.space.free[layout.ratio[i]]
    return {
        "file": recording.path, "sha256": recording.sha256, "rate": recording.rate,
        "onset_s": recording.onset / recording.rate, "v_H0": v,
        "v_H0_interval": [float(v * np.exp(-reach)), float(v * np.exp(reach))] if reach > 0 else None,
        "v_H0_status": "assumed" if rests else "fixed" if known or reach == 0 else "free",
        "gain": heard.fitted.voice.gain, "gain_status": "free" if start.scale is None else "fixed",
        "first": i == 0, "cents": float(fit.values[layout.cents[i]]), "group": layout.groups[i],
        "strike": sorted(set(layout.strikes)).index(layout.strikes[i]),
        "criterion": heard.criterion, "levels": heard.levels,
    }  # fmt: skip


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
        "partials": int(fit.data.found.sum()), "contact_rate_Hz": float(fit.target.rate), "modes": fit.cfg.n_modes,
        "scatter": {"frequency_cents": fit.spread.frequency, "decay_relative": fit.spread.decay,
                    "level_db": fit.spread.level, "rough_db": fit.spread.rough / ROUGHER},
        "correlated": [{"pair": [a, b], "correlation": r} for a, b, r in tangled(cov)],
    }  # fmt: skip
