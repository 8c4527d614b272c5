"""The tuning of a piano as it was recorded, and its tuning curves, with intervals.

Fits measure pitch and inharmonicity of some keys. The keyboard posterior determines those of all 88 jointly
(`instrument.keyboard_posterior`). Every number here is a function of draws from this posterior, so its interval
includes all correlations between keys, and between pitch and inharmonicity of a key.
"""

import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.special import bdtr

from ..analysis.note_names import midi_to_note
from ..conversions import A4, CENTS, HALF_WIDTH_95, HIGHEST_KEY, LOWEST_KEY, hertz_of
from ..errors import FitError, ParameterError, check_range, check_type
from ..instrument import find_fits, load_instrument, load_keys
from ..instrument.build import ENOUGH_KEYS, published_values, reference_values
from ..instrument.collect_fits import instrument_title
from ..instrument.key_quantities import LAW_QUANTITIES, law_quantities
from ..instrument.keyboard_posterior import JointLaws, KeyMeasurements, Measurement, joint_laws
from ..io.files import as_path, printable
from ..io.number_format import counted
from ..literature import typical_strings
from ..modal_response import fastest_beat
from ..model.modal_response import LATE, ModalResponse, PartialDecay, decays_and_beats
from ..schema.instrument import INSTRUMENT_FILE, OwnFit, is_instrument
from ..schema.tuning import IntervalValue, OctaveType, PartialBeat, TunedKey, Tuning
from .curves import OCTAVE_TYPES, partial_cents, tuning_curve

KEYS = np.arange(LOWEST_KEY, HIGHEST_KEY + 1)
# The quantities of a tuning, by the names of their laws.
CHOSEN = ("cents", "B")
# Range of A4, Hz: from a whole tone below 440 Hz (baroque and French pitches) to a whole tone above.
LOWEST_A4, HIGHEST_A4 = 390.0, 495.0
# Draws of the posterior, and their seed. The ends of 95 % intervals then vary by 4 % of a standard deviation.
DRAWS, SEED = 4000, 0
ENDS = (2.5, 97.5)  # percentiles
# Split of a unison up to which listeners prefer it, cents: a largest deviation of 1 to 2 cents among three strings (R.
# E. Kirk, J. Acoust. Soc. Am. 31, 1644, 1959).
PREFERRED_UNISON = 2.0
SLOWEST_BEAT = 1 / LATE[1]  # Hz; `decays_and_beats` does not report slower ones
HINT = "give the folder of pianofit batch, fit.json files, or one instrument.json"


class Recorded(NamedTuple):
    """Measurements of an instrument."""

    name: str
    quantities: tuple[str, ...]  # that the measurements have
    keys: tuple[KeyMeasurements, ...]  # ascending
    reference: np.ndarray  # literature, on the scales of the laws [quantities, 88]
    responses: Mapping[int, ModalResponse]  # by MIDI number
    unconverged: tuple[int, ...]
    has_unisons: bool = True  # keys with two or three strings; a plucked key has one


def tuning(
    paths: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    prefix: str | None = None,
    a4: float = A4,
    octave: OctaveType = "4:2",
) -> Tuning:
    """Determine the tuning of a piano from fits of some of its keys, and compute tuning curves for it.

    Parameters
    ----------
    paths : the folder of `pianofit batch`, one or several `fit.json` files, or an `instrument.json`.
    prefix : name of the instrument, if a folder holds fits of several.
    a4 : frequency of partial 1 of A4, Hz.
    octave : octave type of the target: "2:1", "4:2" or "6:3".

    Returns
    -------
    A `Tuning` with pitch, inharmonicity, tuning curves and beats of all 88 keys, with 95 % intervals.

    Raises
    ------
    FitError
        If a file is neither a fit nor an instrument, or an instrument has no recorded key.
    ParameterError
        For an `a4` beyond 390 to 495 Hz, an unknown octave type, or an instrument together with other files.

    Examples
    --------
    >>> import pianofit
    >>> found = pianofit.tuning("batch", prefix="cp80")
    >>> [key.note for key in found.keys if key.recorded]
    ['C4', 'E4']
    >>> a4 = found.keys[48]
    >>> a4.note, a4.target.value
    ('A4', 440.0)
    """
    check_range("a4=", a4, LOWEST_A4, HIGHEST_A4, " Hz")
    if octave not in OCTAVE_TYPES:
        raise ParameterError(f"octave={octave!r} must be one of {', '.join(OCTAVE_TYPES)}")
    check_type("paths=", paths, str | os.PathLike | Sequence, "a path, or a list of paths")
    files = [Path(paths)] if isinstance(paths, str | os.PathLike) else [as_path(path) for path in paths]
    if not files:
        raise ParameterError(f"paths=[] is empty; {HINT}")
    recorded = load_recorded(files, prefix)
    return tuning_of(recorded, posterior_of(recorded), float(a4), octave)


def posterior_of(recorded: Recorded) -> JointLaws:
    """Return the joint posterior of the `CHOSEN` quantities of all 88 keys."""
    priors = [LAW_QUANTITIES[name].prior for name in recorded.quantities]
    chosen = [recorded.quantities.index(name) for name in CHOSEN]
    return joint_laws(recorded.keys, recorded.reference, priors, KEYS.tolist(), chosen)


def tuning_of(recorded: Recorded, posterior: JointLaws, a4: float, octave: OctaveType) -> Tuning:
    """Return the tuning that a posterior describes; arguments as of `tuning`."""
    draws = np.concatenate([posterior.mean[None], posterior.draw(DRAWS, np.random.default_rng(SEED))])
    curves = {name: tuning_curve(np.exp(draws[:, 1, 1]), k) for name, k in OCTAVE_TYPES.items()}
    columns = {name: _estimates(column) for name, column in _columns(draws, a4, curves[octave]).items()}
    by_type = {name: _estimates(curve) for name, curve in curves.items()}
    measured, keys = {key.midi for key in recorded.keys}, []
    for i, midi in enumerate(KEYS.tolist()):
        own: dict[str, Any] = {name: column[i] for name, column in columns.items()}
        if midi not in measured:
            own["deviation"] = None
        own["curves"] = {name: curve[i] for name, curve in by_type.items()}
        own |= _unison(midi, recorded.responses.get(midi) if recorded.has_unisons else None)
        keys.append(TunedKey(midi=midi, note=midi_to_note(midi), recorded=midi in measured, **own))
    return _listed(recorded, tuple(keys), a4, octave)


def _columns(draws: np.ndarray, a4: float, curve: np.ndarray) -> dict[str, np.ndarray]:
    """Numbers of a `TunedKey` for all draws and keys, from draws of laws and values and the chosen curve."""
    offset = CENTS * math.log(a4 / A4)
    tempered = np.array([hertz_of(midi) for midi in KEYS.tolist()])
    law, found = (row[:, 0] + partial_cents(np.exp(row[:, 1]), 1) - offset for row in (draws[:, 0], draws[:, 1]))
    return {
        "f0": tempered * np.exp(draws[:, 1, 0] / CENTS),
        "B": np.exp(draws[:, 1, 1]),
        "first_partial": tempered * np.exp((found + offset) / CENTS),
        "as_found": found,
        "law": law,
        "target": tempered * (a4 / A4) * np.exp(curve / CENTS),
        "change": curve - found,
        "deviation": found - law,
    }


def _estimates(draws: np.ndarray) -> list[IntervalValue]:
    """Values of all keys from a first row at the posterior mean and rows of draws [1 + draws, 88]."""
    low, high = np.percentile(draws[1:], ENDS, axis=0)
    ends = zip(np.minimum(low, draws[0]).tolist(), np.maximum(high, draws[0]).tolist(), strict=True)
    return [IntervalValue(value, pair) for value, pair in zip(draws[0].tolist(), ends, strict=True)]


def _listed(recorded: Recorded, keys: tuple[TunedKey, ...], a4: float, octave: OctaveType) -> Tuning:
    """Return the tuning with its lists of keys."""
    deviations = {key.note: key.deviation for key in keys if key.deviation}
    off = {note: abs(it.value) for note, it in deviations.items() if not it.interval[0] <= 0.0 <= it.interval[1]}
    unisons = {key.note: key.unison_cents for key in keys if key.unison_cents}
    wide = {note: it.value for note, it in unisons.items() if it.interval[0] > PREFERRED_UNISON}
    has_law = len(recorded.keys) >= ENOUGH_KEYS
    return Tuning(
        name=recorded.name,
        a4=a4,
        octave=octave,
        keys=keys,
        off=tuple(sorted(off, key=off.__getitem__, reverse=True)) if has_law else (),
        wide_unisons=tuple(sorted(wide, key=wide.__getitem__, reverse=True)),
        warnings=tuple(_warnings(recorded, has_law)),
    )


def _warnings(recorded: Recorded, has_law: bool) -> list[str]:
    warnings = []
    if not has_law:
        source = "the literature" if recorded.has_unisons else "priors"
        warnings.append(
            f"Only {counted(len(recorded.keys), 'key')} measured, fewer than {ENOUGH_KEYS}. The shape of the laws "
            f"comes from {source}, and deviations from the law are not listed."
        )
    if recorded.unconverged:
        names = ", ".join(map(midi_to_note, recorded.unconverged))
        warnings.append(f"The fits of {names} did not converge; their intervals are doubled.")
    if recorded.has_unisons and not recorded.responses:
        warnings.append("No fit has a modal response, so beats are not known.")
    return warnings


# --- beats ------------------------------------------------------------------------------------------------------------


def _unison(midi: int, response: ModalResponse | None) -> dict[str, Any]:
    """Beats of a key, and the split of its unison.

    A mistuned unison splits all partials by the same number of cents. So the split is the median over partials. The
    beats alone give a first value. Partials count in which this split, but at least the preferred one, would be a
    measurable beat. One that does not beat counts as 0 cents, if such a beat would have been found. One with a mode at
    its limit counts with that beat, although its strings can be farther apart. The interval is that of a median, from
    the order of the ends of the partials' own intervals. Fewer than six partials determine none of 95 %, and a key with
    one string has no unison.
    """
    decays = [] if response is None or round(typical_strings(midi)) < 2 else decays_and_beats(response)
    if not decays:
        return {}
    beats = {it.number: _beat(it) for it in decays if not math.isnan(it.beat_frequency)}
    fastest = fastest_beat(decays[0].frequency / decays[0].number)
    first = float(np.median([beat.cents.value for beat in beats.values()] or [0.0]))
    ratio = math.expm1(max(first, PREFERRED_UNISON) / CENTS)
    counted = [
        it
        for it in decays
        if ratio * it.frequency >= SLOWEST_BEAT and (it.number in beats or ratio * it.frequency < fastest)
    ]
    cents = [beats[it.number].cents if it.number in beats else IntervalValue(0.0, (0.0, 0.0)) for it in counted]
    # The median of all partials lies below the lowest `rank` of these with a probability of 2.5 % at most.
    rank = int((bdtr(np.arange(len(cents)), len(cents), 0.5) <= ENDS[0] / 100).sum())
    if not rank:
        return {"beats": tuple(beats.values())}
    lows, highs = (sorted(it.interval[end] for it in cents) for end in (0, 1))
    median = float(np.median([it.value for it in cents]))
    return {"beats": tuple(beats.values()), "unison_cents": IntervalValue(median, (lows[rank - 1], highs[-rank]))}


def _beat(partial: PartialDecay) -> PartialBeat:
    """Beats of a partial. The largest error of its poles bounds those of the two modes that interfere."""
    rate = partial.beat_frequency
    half = HALF_WIDTH_95 * math.sqrt(2) * partial.error[1] / (2 * math.pi)
    ends = (max(rate - half, 0.0), rate + half)
    low, value, high = (CENTS * math.log1p(x / partial.frequency) for x in (ends[0], rate, ends[1]))
    return PartialBeat(
        partial.number,
        partial.frequency,
        IntervalValue(rate, ends),
        IntervalValue(value, (low, high)),
        partial.beat_depth,
    )


# --- files ------------------------------------------------------------------------------------------------------------


def load_recorded(paths: Sequence[Path], prefix: str | None) -> Recorded:
    """Read the measurements of fits, or those that an instrument records; errors as of `tuning`."""
    built = next((path for path in paths if _is_instrument(path)), None)
    if built is None:
        return _from_fits(paths, prefix)
    if len(paths) > 1:
        raise ParameterError(f"{printable(built)}: is a whole instrument; give it alone, or only fits")
    return _from_instrument(built, prefix)


def _is_instrument(path: Path) -> bool:
    return (path / INSTRUMENT_FILE).is_file() or (path.is_file() and is_instrument(path, HINT))


def _from_fits(paths: Sequence[Path], prefix: str | None) -> Recorded:
    files = find_fits(paths, prefix)
    keys = load_keys(files)
    return Recorded(
        instrument_title(paths, files, prefix),
        tuple(law_quantities(keys[0].law)),
        tuple(key.measured for key in keys),
        reference_values(keys, KEYS.tolist()),
        {key.midi: key.note.modal_response for key in keys if key.note.modal_response is not None},
        tuple(key.midi for key in keys if not key.summary.converged),
        keys[0].law.has_contact,
    )


def _from_instrument(path: Path, prefix: str | None) -> Recorded:
    """Measurements of an instrument. It records each value of a fit with its interval, without correlations."""
    instrument = load_instrument(path, prefix)
    keys, responses = [], {}
    for midi, key in sorted(instrument.keys.items()):
        own = [key.values[name].own_fit if name in key.values else None for name in CHOSEN]
        fits = [fit for fit in own if fit is not None]
        if len(fits) == len(CHOSEN):
            keys.append(KeyMeasurements(midi, (_measurement(fits),), np.zeros(len(CHOSEN))))
            if key.note.modal_response is not None:
                responses[midi] = key.note.modal_response
    if not keys:
        raise FitError(f"{printable(path)}: has no key with a fit; {HINT}")
    mean = dict(zip(CHOSEN, np.mean([key.minima[0].mean for key in keys], axis=0), strict=True))
    rows = [published_values(midi, instrument.law) for midi in KEYS.tolist()]
    reference = np.array([[row.get(name, mean[name]) for row in rows] for name in CHOSEN])
    unconverged = tuple(m for m, key in instrument.keys.items() if key.fit is not None and not key.fit.converged)
    return Recorded(instrument.name, CHOSEN, tuple(keys), reference, responses, unconverged, instrument.law.has_contact)


def _measurement(fits: Sequence[OwnFit]) -> Measurement:
    scales = [LAW_QUANTITIES[name] for name in CHOSEN]
    mean = np.array([float(scale.scaled(fit.value)) for scale, fit in zip(scales, fits, strict=True)])
    half = [0.5 * float(np.diff(scale.scaled(fit.interval))[0]) for scale, fit in zip(scales, fits, strict=True)]
    return Measurement(1.0, mean, np.diag(np.square(half) / HALF_WIDTH_95**2))
