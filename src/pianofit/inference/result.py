"""A fit in words and numbers: the document that becomes `fit.json`, and the sounds it compares."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .. import __version__
from ..analysis import Analysis, Partials
from ..criterion import BANDS, band_of, band_values, borders, closed_form_gain, level_error_db, line_sigma, measure
from ..io import FIT_SCHEMA as SCHEMA
from ..model import Simulation
from ..model.note import Note
from ..model.path import OutputPath
from ..parameters import MEMORY_NAMES, PARAMETERS
from ..recording import Recording
from .align import touched
from .start import Start

__all__ = ["SCHEMA", "UNITS", "Heard", "Listener", "Result", "Sound", "scored", "versions", "worse_bands"]

# Levels are compared over partials to this, Hz: few hammers reach beyond,
LEVEL_TOP = 6000.0
# within so many dB of the strongest: other sounds lie there.
LEVEL_RANGE = 60.0
UNITS = {name: p.unit for name, p in PARAMETERS.items()} | {
    "x0": "m", "M_S": "kg", "L": "m", "width": "m", "pickup": "m",
}  # fmt: skip


@dataclass(frozen=True)
class Sound:
    """One set of parameters, as it sounds."""

    note: Note
    samples: np.ndarray  # file units, as long as the recording
    simulation: Simulation
    level: np.ndarray  # dB, [partials], gain and path included, in the recording's unit


@dataclass(frozen=True)
class Heard:
    """One recording beside what the model makes of it."""

    initial: Sound
    fitted: Sound
    level: np.ndarray  # dB, [partials], measured, in the pickup's unit
    recording: Recording
    analysis: Analysis
    criterion: dict
    levels: dict

    @property
    def partials(self) -> Partials:
        """The table of partials."""
        return self.analysis.partials


@dataclass(frozen=True)
class Result:
    """A finished fit. `document` is what `fit.json` holds, `takes` are in the order in which they were given.

    What a page shows of one recording is that of the `first`, the reference. `covariance` is that of log(value) at the
    best minimum, in the order of `coordinates.VALUES` and then the strokes' velocities; zero for what was not fitted.
    `notes` are what plays each minimum, for every recording, and `shares` their weights. `draws` are the posterior's,
    where it was asked for: values [chains, draws] by name.
    """

    document: dict
    takes: tuple[Heard, ...]
    first: int
    covariance: np.ndarray
    notes: tuple[tuple[Note, ...], ...]
    shares: tuple[float, ...]
    draws: dict[str, np.ndarray] | None = None

    @property
    def initial(self) -> Sound:
        """Before the fit, reference recording."""
        return self.takes[self.first].initial

    @property
    def fitted(self) -> Sound:
        """After the fit, reference recording."""
        return self.takes[self.first].fitted

    @property
    def recording(self) -> Recording:
        """As it was read, reference recording."""
        return self.takes[self.first].recording

    @property
    def analysis(self) -> Analysis:
        """Of the reference recording."""
        return self.takes[self.first].analysis

    @property
    def worse_bands(self) -> list[str]:
        """Occupied bands, and `global`, whose criterion ended no lower than it started."""
        return worse_bands(self.document["criterion"])


def worse_bands(criterion: dict) -> list[str]:
    """Occupied bands, and `global`, in which the criterion ended no lower than it started."""
    names = [n for n in ("global", *BANDS) if n in criterion]
    return [n for n in names if criterion[n]["final"] >= criterion[n]["initial"]]


def scored(frequency: np.ndarray, level: np.ndarray) -> np.ndarray:
    """The partials on which levels are compared [partials], bool."""
    return (frequency <= LEVEL_TOP) & (level >= level.max() - LEVEL_RANGE)


def versions() -> dict[str, str]:
    """Of the program and of everything the numbers depend on."""
    import jax
    import scipy

    return {
        "pianofit": __version__, "python": platform.python_version(), "jax": jax.__version__,
        "numpy": np.__version__, "scipy": scipy.__version__,
    }  # fmt: skip


@dataclass(frozen=True)
class Listener:
    """A recording on the paper's criterion: cells, and what any other sound of the same length gives on them."""

    recording: Recording
    analysis: Analysis
    sigma: float
    spacing: np.ndarray
    energy: np.ndarray

    @classmethod
    def of(cls, recording: Recording, analysis: Analysis) -> Listener:
        """The listener to one recording."""
        sigma = line_sigma(analysis.f0)
        last = int(analysis.partials.number.max())
        cells, energy = measure(
            recording.samples[recording.onset :], recording.rate, analysis.f0, analysis.B, last, sigma
        )
        return cls(recording, analysis, sigma, cells.spacing, energy)

    @property
    def last(self) -> int:
        """Number of the highest partial found."""
        return int(self.analysis.partials.number.max())

    @property
    def occupied(self) -> tuple[str, ...]:
        """Bands with a partial above the noise."""
        return tuple(BANDS[b] for b in np.unique(band_of(self.analysis.partials.number)))

    def hear(self, samples: np.ndarray) -> np.ndarray:
        """|Y|² [partials, nodes] of a sound aligned to the recording."""
        a, r = self.analysis, self.recording
        return measure(samples[r.onset :], r.rate, a.f0, a.B, self.last, self.sigma)[1]

    def play(self, note: Note, gain: float | None, begins: int | None, level: np.ndarray) -> Sound:
        """A note laid on the recording, with the gain that the criterion likes best if none is given.

        Parameters
        ----------
        begins : the sample at which the hammer touches; where its sound would be seen at the onset if None.
        level : dB, [partials], through a gain of 1.
        """
        strike = note.strike(self.recording.rate)
        begins = touched(note, strike, self.recording) if begins is None else begins
        samples = note.heard(strike, self.recording.rate, len(self.recording.samples), begins)
        if gain is None:
            gain = float(np.sqrt(closed_form_gain(self.hear(samples), self.energy, self.spacing[:, None])))
            level = level + 20 * np.log10(max(gain, 1e-15))
        return Sound(note._replace(gain=gain), samples * gain, strike, level)

    def criterion(self, initial: Sound, fitted: Sound) -> dict:
        """Eq. 19 per band on the sounds themselves, from the onset on; bands without a partial are dropped."""
        before, after = (band_values(self.hear(s.samples), self.energy, self.spacing) for s in (initial, fitted))
        kept = {"global", *self.occupied}
        values = {name: {"initial": before[name], "final": after[name]} for name in before if name in kept}
        return values | {
            "dropped": [name for name in BANDS if name not in kept],
            "sigma": self.sigma,
            "borders": list(borders(self.analysis.f0, self.analysis.B, self.last)),
        }


def level_errors(levels: dict[str, np.ndarray | None], p: Partials, measured: np.ndarray) -> dict:
    """Rms errors, dB, of levels [partials] by name, one gain removed, and how many partials were compared."""
    chosen = scored(p.frequency, measured)
    of = {n: None if x is None else level_error_db(x[chosen], measured[chosen]) for n, x in levels.items()}
    return of | {"partials": int(chosen.sum())}


def together(levels: Sequence[dict]) -> dict:
    """Level errors over all recordings, dB rms, and the partials counted."""
    count = np.array([x["partials"] for x in levels])

    def rms(name: str) -> float | None:
        values = [x[name] for x in levels]
        return None if None in values else float(np.sqrt((np.square(values) * count).sum() / count.sum()))

    return {name: rms(name) for name in ("initial_db", "fitted_db", "path_only_db")} | {"partials": int(count.sum())}


def given(value: float, name: str, status: str) -> dict:
    """What no fit searches."""
    return {
        "value": float(value), "unit": UNITS[name], "interval": None, "interval_by": None, "interval_open": [],
        "status": status, "initial": float(value), "note": "",
    }  # fmt: skip


def sizes(start: Start) -> dict[str, dict]:
    """The string's length and mass, and the pickup's position, as `parameters` has them."""
    g = start.geometry
    table = {
        name: given(value, name, "assumed" if key in start.assumed else "given")
        for name, value, key in (("M_S", g.mass, "mass"), ("L", g.length, "length"))
    }
    if start.quantity in ("velocity", "displacement"):
        table["pickup"] = given(g.pickup, "pickup", "given")
    return table


def derived(note: Note, simulation: Simulation, analysis: Analysis) -> dict:
    """What follows from the parameters, and what the stroke did."""
    pulse, g = simulation.pulse, note.geometry
    f0 = note.string.c / (2 * g.length)
    B = (note.string.kappa * np.pi / (note.string.c * g.length)) ** 2
    u = float(pulse.compression.max())
    return {
        "f0": float(f0), "B": float(B), "f1": float(f0 * np.sqrt(1 + B)), "M_H/M_S": float(note.hammer.M_H / g.mass),
        "x0/L": float(g.strike / g.length), "contact_ms": 1e3 * simulation.contact_time,
        "max_force_N": float(pulse.force.max()), "max_compression_mm": 1e3 * u,
        "felt_force_N": float(note.hammer.K_H * u**note.hammer.p),
        "glide_cents": float(analysis.glide_cents),
        "glide": [{"start_s": a, "stop_s": b, "f0": f} for a, b, f in analysis.glide],
    }  # fmt: skip


def path_document(path: OutputPath | None) -> dict | None:
    """A path as `fit.json` holds it."""
    if path is None:
        return None
    return {name: column.tolist() for name, column in path._asdict().items() if column is not None}


def absent(name: str, felt: str) -> dict:
    """A loss that the felt's law does not have."""
    return given(0.0, name, "given") | {"note": f"the felt's law, {felt}, has none"}


def is_memory(name: str) -> bool:
    """Whether only a felt that relaxes has this parameter."""
    return name in MEMORY_NAMES
