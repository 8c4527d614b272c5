"""A synthetic recording: one simulated stroke, recorded as a calibrated measurement with noise.

The setup that belongs to it states the sizes, the strike, the pickup and the scale. It does not state the parameters of
the string or the hammer. A fit of the recording has to find them, and `true` has the correct values.
"""

import json
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .errors import ParameterError, check_range
from .felt import plain_law
from .io.files import PEAK_LIMIT
from .literature import preset
from .model import Simulation, simulate
from .model.note import MAX_SECONDS, check_render
from .model.simulate import MAX_STEPS
from .parameters import Geometry, String, check_seed
from .recording.recording import Recording, recording_from_samples
from .setup import RANGES, SETUP_KEYS, Measured, RecordingInfo, Setup
from .transducer import ON_STRING, TRANSDUCERS

# s of silence before the first contact. The noise of a recording is measured in at least 0.05 s of it.
LEAD = 0.06
# s of the note whose rms is the reference of the noise level.
REFERENCE_SECONDS = 1.0
# Largest refinement of the contact's time step relative to `simulate`. The error is of second order. With 16 times the
# steps it is below 1e-5 of the force, so a fit, which extrapolates its own step to zero, recovers the true parameters.
MAX_REFINEMENT = 16
MAX_NOISE_DB = 200.0  # dB below the note, below the rounding of 32 bit samples


@dataclass(frozen=True, eq=False, repr=False)
class SyntheticRecording:
    """A simulated stroke as a recording, the setup that calibrates it, and the true parameters."""

    samples: np.ndarray  # [samples], ±1 = full scale
    rate: int  # Hz
    onset: int  # sample of the first contact
    scale: float  # pickup units (m/s, m or N) at full scale
    setup: Setup
    true: dict[str, float]  # parameters of string and hammer, by name
    simulation: Simulation
    name: str

    def __repr__(self) -> str:
        seconds = len(self.samples) / self.rate
        return f"SyntheticRecording {self.name}: {seconds:.2f} s at {self.rate} Hz, full scale = {self.scale:.4g}"

    @property
    def recording(self) -> Recording:
        """The samples as a `Recording`, for `fit`."""
        return recording_from_samples(self.samples, self.rate, name=self.name)

    @property
    def setup_text(self) -> str:
        """The content of a `setup.toml` that makes the sound a calibrated measurement; comments list `true`."""
        values = "".join(f"# {name} = {value!r}\n" for name, value in self.true.items())
        return f"{setup_text(self.setup)}\n# True parameters of the simulation. A fit does not read comments.\n{values}"


def synthetic_recording(
    string: String,
    hammer: Any,
    geometry: Geometry,
    *,
    rate: int = 44_100,
    seconds: float = 3.0,
    quantity: str = "velocity",
    scale: float | None = None,
    noise_db: float | None = None,
    seed: int = 0,
    name: str = "synthetic.wav",
) -> SyntheticRecording:
    """Simulate one stroke and record it with leading silence, a scale, and white noise.

    Parameters
    ----------
    string, geometry : string and geometry in SI units. `geometry` has the strike position and the pickup position.
    hammer : a `Hammer`, a `SoftHammer`, a `RelaxingHammer`, or a hammer of a `FeltLaw`, or a `Pluck`.
    rate : Hz.
    seconds : length of the sound, s. The first 0.06 s of it are silent.
    quantity : what the pickup records: velocity, displacement, bridge-force or pressure.
    scale : pickup units at digital full scale: m/s, m or N. If None, the scale at which the peak is -1 dBFS.
    noise_db : rms of the first second of the note over rms of the noise, dB. If None, no noise.
    seed : seed of the noise.
    name : name of the sound file in the setup.

    Returns
    -------
    A `SyntheticRecording`: samples, setup and true parameters.

    Raises
    ------
    ParameterError
        For a value outside its range, or a scale that the note exceeds.
    FitError
        If the contact does not end.

    Examples
    --------
    >>> import pianofit
    >>> it = pianofit.typical("C4")
    >>> made = pianofit.synthetic_recording(it.string, it.hammer, it.geometry, scale=10.0, noise_db=60)
    >>> made.setup.pickup_scale, made.recording.seconds
    (10.0, 3.0)
    """
    check_render(None, seconds, rate)
    check_range("seconds=", seconds, LEAD, MAX_SECONDS)
    check_seed(seed)
    if scale is not None:
        check_range("scale=", scale, *RANGES["scale"][:2])
    if noise_db is not None:
        check_range("noise_db=", noise_db, 0, MAX_NOISE_DB, " dB", "; it is the level of the note over the noise")
    stroke = _stroke(string, hammer, geometry, rate, quantity)
    lead = round(LEAD * rate)
    note = stroke.waveform(rate, round(seconds * rate) - lead)
    scale = _scale(note, scale)
    samples = np.pad(note / scale, (lead, 0)) + _noise(note / scale, noise_db, seed, rate, lead)
    setup = setup_of(hammer, geometry, quantity, scale, name)
    return SyntheticRecording(samples, rate, lead, scale, setup, _values(string, hammer), stroke, name)


def demo_recording(noise_db: float | None = 60.0, seed: int = 0) -> SyntheticRecording:
    """The recording of the demo: the final values of the paper, with a setup that starts from its initial values."""
    final, initial = preset("bensa-final"), preset("bensa-initial")
    rate, lead, scale = 44_100, 2_205, 2.0  # Hz; samples of silence, 0.05 s; m/s at full scale
    stroke = simulate(final.string, final.hammer, final.geometry, rate=rate, oversampling=32)
    note = stroke.waveform(rate, 3 * rate) / scale
    samples = np.pad(note, (lead, 0)) + _noise(note, noise_db, seed, rate, lead)
    setup = setup_of(final.hammer, final.geometry, "velocity", scale, "synthetic.wav")
    setup = replace(setup, initial=_values(initial.string, initial.hammer), recordings=())
    true = _values(final.string, final.hammer)
    return SyntheticRecording(samples, rate, lead, scale, setup, true, stroke, "synthetic.wav")


def _values(string: String, hammer: Any) -> dict[str, float]:
    """The parameters of string and hammer by name."""
    names = (*String._fields, *plain_law(hammer).hammer_parameters)
    return {key: float(value) for key, value in {**string._asdict(), **hammer._asdict()}.items() if key in names}


def _stroke(string: String, hammer: Any, geometry: Geometry, rate: int, quantity: str) -> Simulation:
    """Simulate the stroke with the shortest time steps that the step limit of `simulate` allows."""
    coarse = simulate(string, hammer, geometry, rate=rate, quantity=quantity)
    refinement = min(MAX_REFINEMENT, MAX_STEPS // len(coarse.pulse.force))
    if refinement <= 1:
        return coarse
    oversampling = refinement * round(1.0 / (rate * float(coarse.modes.step)))
    return simulate(string, hammer, geometry, rate=rate, quantity=quantity, oversampling=oversampling)


def _scale(note: np.ndarray, scale: float | None) -> float:
    """Pickup units at full scale: the given value, or the default for the peak of the note."""
    peak = float(np.abs(note).max())
    if scale is None:
        return max(peak, np.finfo(float).tiny) / PEAK_LIMIT
    if peak > scale:
        raise ParameterError(f"scale={scale:g} is less than the peak of the note, {peak:.4g}; give a larger scale")
    return float(scale)


def _noise(note: np.ndarray, db: float | None, seed: int, rate: int, lead: int) -> np.ndarray:
    """White noise for the whole sound [lead + samples]."""
    if db is None:
        return np.zeros(lead + len(note))
    rms = math.sqrt(float(np.mean(note[: round(REFERENCE_SECONDS * rate)] ** 2)))
    return rms * 10 ** (-db / 20) * np.random.default_rng(seed).standard_normal(lead + len(note))


def setup_of(hammer: Any, geometry: Geometry, quantity: str, scale: float, name: str) -> Setup:
    """The setup of the measurement, as a laboratory would write it."""
    length, mass, strike, width, pickup = map(float, geometry)
    law = plain_law(hammer)
    return Setup(
        length=length,
        mass=mass,
        strike_position=strike,
        strike_width=width,
        pickup_quantity=quantity,
        pickup_position=pickup if quantity in ON_STRING else None,
        # An unknown output path has no scale, and the size of a pluck is unknown.
        pickup_scale=None if TRANSDUCERS[quantity].unknown_path or not law.has_contact else scale,
        recordings=(RecordingInfo(file=name),),
        felt=None if not law.has_contact else law.name if law.hammers is not None else law,
        excitation=law.kind,
    )


def setup_text(setup: Setup) -> str:
    """The content of the `setup.toml` that `Setup.from_toml` reads as `setup`; its felt law must be built in."""
    tables: dict[str, list[str]] = {}
    for attribute, (table, key) in SETUP_KEYS.items():
        value = setup.law.name if attribute == "felt" else getattr(setup, attribute)
        if (attribute == "felt") != setup.law.has_contact and attribute in ("felt", "excitation"):
            continue  # a file names the felt law of a hammer, or another excitation
        if value is not None:
            unit = f"  # {UNITS[key]}" if key in UNITS else ""
            tables.setdefault(table, []).append(f"{key} = {_toml(value)}{unit}")
    for table in ("fixed", "initial", "bounds"):
        tables[table] = [f"{key} = {_toml(value)}" for key, value in getattr(setup, table).items()]
    text = "\n".join("\n".join([f"[{table}]", *lines, ""]) for table, lines in tables.items() if lines)
    for recording in setup.recordings:
        given = {key: value for key, value in vars(recording).items() if value is not None}
        text += "\n".join(["", "[[recording]]", *(f"{key} = {_toml(value)}" for key, value in given.items()), ""])
    return text


UNITS = {"length": "m", "mass": "kg", "position": "m from the agraffe", "width": "m", "scale": "units at full scale"}


def _toml(value: Any) -> str:
    """A value in TOML: a text, a number, a measured value, or a list of numbers."""
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, Measured):
        return f"{{value = {float(value)!r}, sd = {value.sd!r}}}"
    return repr([*value]) if isinstance(value, tuple) else repr(value)
