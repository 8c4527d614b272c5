"""From the fits of single keys to a whole instrument.

The fits measure the `LAW_QUANTITIES` of their keys, and the posterior of the whole keyboard gives those of all 88
(`keyboard_posterior`). A recorded key is played as it was fitted, unless it is evened out (`evened_keys`). The keyboard
sets only its scale of velocities, where the recordings leave it open. Any other key takes the values of the laws, and
its modal response is a guess from those of the recorded keys (`guessed_responses`).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ..analysis.note_names import midi_to_note
from ..conversions import HIGHEST_KEY, LOWEST_KEY
from ..errors import ParameterError, check_range
from ..excitation import Excitation
from ..io.number_format import counted
from ..model.note import Note
from ..schema.extras import KeyExtras
from ..schema.instrument import KeyboardLaw, KeyValue, OwnFit
from ..threads import numerical_settings
from .bridge import measure_bridge
from .collect_fits import KeyFit, scale_key
from .dampers import damper_law
from .evened_keys import even_out
from .guessed_responses import guess_response, keyboard_string_law, recorded_keys
from .instrument import Instrument, Key
from .key_quantities import (
    LAW_QUANTITIES,
    law_quantities,
    literature,
    note_from_quantities,
    stroke_level,
)
from .keyboard_posterior import KeyboardPosterior, keyboard_posterior
from .measured_fields import KeyFields, PathField, measure_fields, measure_path
from .noise_floor import noise_floor
from .release_noise import release_noise
from .velocity_curve import fit_velocity_curve, velocity_warnings

KEYS = np.arange(LOWEST_KEY, HIGHEST_KEY + 1)
# With fewer keys, the shapes of the laws come from the literature.
ENOUGH_KEYS = 5
# Deviation from the prediction of all other keys beyond which a key is named, standard deviations.
NAMED_SD = 4.0
# Share of a minimum above which the keyboard has decided against the fit.
DECIDED = 0.5


@numerical_settings()
def build_instrument(
    keys: Sequence[KeyFit], name: str = "", even: float = 0.0, extras: Sequence[KeyExtras] = ()
) -> Instrument:
    """Combine the fits of single keys to an instrument of 88 keys.

    Parameters
    ----------
    keys : fits in ascending order of keys, as `load_keys` returns them.
    name : name of the instrument.
    even : how far recorded keys move towards the laws in level, decay and brightness, from 0 (as fitted) to 1.
    extras : dampers, release noise and noise floors, as `load_extras` returns them.

    Returns
    -------
    An `Instrument` with a note for every key. Keys that were never recorded follow from smooth laws over the keyboard.

    Raises
    ------
    ParameterError
        Without any fit, or for a value of `even` beyond 0 to 1.

    Examples
    --------
    >>> from pathlib import Path
    >>> import pianofit
    >>> pianofit.build_instrument(pianofit.load_keys(pianofit.find_fits([Path("batch")], "cp80")), "my CP80")
    Instrument('my CP80', 88 keys, 2 recorded)
    """
    check_range("even=", even, 0.0, 1.0)
    if not keys:
        raise ParameterError("no fit was given; an instrument needs at least one fit.json")
    reference = reference_values(keys, KEYS.tolist())
    quantities = law_quantities(keys[0].law)
    priors = [quantity.prior for quantity in quantities.values()]
    posterior = keyboard_posterior([key.measured for key in keys], reference, priors, KEYS.tolist())
    keys = [scale_key(key, math.exp(scale)) for key, scale in zip(keys, posterior.log_scale, strict=True)]
    laws = {n: _keyboard_law(q, n, posterior, reference, keys[0].law) for q, n in enumerate(quantities)}
    recorded = {key.midi: Key(key.note, "recorded", _values(key.midi, posterior, keys), key.summary) for key in keys}
    seen = recorded_keys(recorded, laws)
    fields, path = measure_fields(seen), measure_path(seen)
    # Guesses follow from the keys as recorded. They are even already, and the recorded keys move towards them.
    evened = even_out(seen, laws, fields, even)
    recorded = {midi: replace(key, note=evened.get(midi, key.note)) for midi, key in recorded.items()}
    guessed = {
        int(midi): Key(
            _guess(int(midi), laws, fields, path, keys[0]),
            "interpolated" if keys[0].midi < midi < keys[-1].midi else "extrapolated",
            _values(int(midi), posterior, keys),
            is_guessed=True,
        )
        for midi in KEYS
        if midi not in recorded
    }
    layers = [key.summary.layers for key in keys]
    built = Instrument(
        name,
        dict(sorted((recorded | guessed).items())),
        fit_velocity_curve(layers),
        laws,
        (*_warnings(keys, posterior), *velocity_warnings(layers)),
        float(even),
        damper_law(extras),
        bridge=measure_bridge((key.midi, key.note) for key in keys),
    )
    return replace(built, release=release_noise(extras, built.channels), noise=noise_floor(extras, built.channels))


def reference_values(keys: Sequence[KeyFit], at: Sequence[int]) -> np.ndarray:
    """Values of the literature on the scales of the laws [quantities, at]; for the level the mean of the keys.

    No keyboard of plucked strings is published. All their quantities have the mean of the recorded keys.
    """
    law = keys[0].law
    mean = dict(zip(law_quantities(law), np.mean([key.fitted.mean for key in keys], axis=0), strict=True))
    rows = [published_values(int(midi), law) for midi in at]
    return np.array([[row.get(name, value) for row in rows] for name, value in mean.items()])


def published_values(midi: int, law: Excitation) -> dict[str, float]:
    """Return what the literature has of one key, by quantity, on the scales of the laws."""
    values = literature(midi) if law.key_quantities else {"cents": 0.0}
    return {name: float(LAW_QUANTITIES[name].scaled(value)) for name, value in values.items()}


def _keyboard_law(
    q: int, name: str, posterior: KeyboardPosterior, reference: np.ndarray, law: Excitation
) -> KeyboardLaw:
    quantity, shape = LAW_QUANTITIES[name], posterior.shapes[q]
    low, high = quantity.interval(posterior.mean[0, q], posterior.sd[0, q])
    return KeyboardLaw(
        unit=quantity.unit,
        scale=quantity.scale,
        literature=quantity.unscaled(reference[q]) if name in published_values(LOWEST_KEY, law) else None,
        value=quantity.unscaled(posterior.mean[0, q]),
        low=low,
        high=high,
        scatter=shape.scatter,
        length_keys=shape.length,
    )


def _values(midi: int, posterior: KeyboardPosterior, keys: Sequence[KeyFit]) -> dict[str, KeyValue]:
    """Return the posterior of every quantity of one key, and what its own fit measured."""
    numbers = [key.midi for key in keys]
    j = numbers.index(midi) if midi in numbers else None
    found = {}
    for q, (name, quantity) in enumerate(law_quantities(keys[0].law).items()):
        (law, value), (_, sd) = (x[:, q, midi - LOWEST_KEY].tolist() for x in (posterior.mean, posterior.sd))
        own = None
        if j is not None:
            fitted = keys[j].fitted
            mean, own_sd = float(fitted.mean[q]), math.sqrt(fitted.covariance[q, q])
            own = OwnFit(float(quantity.unscaled(mean)), quantity.interval(mean, own_sd), float(posterior.z[q, j]))
        found[name] = KeyValue(
            float(quantity.unscaled(value)), quantity.interval(value, sd), float(quantity.unscaled(law)), own
        )
    return found


def _guess(
    midi: int, laws: Mapping[str, KeyboardLaw], fields: KeyFields | None, path: PathField | None, like: KeyFit
) -> Note:
    """Return the note of a key that was never recorded."""
    values = {name: float(law.value[midi - LOWEST_KEY]) for name, law in laws.items()}
    note = note_from_quantities(values, midi, like.note.quantity, like.law)
    note = note._replace(path=None if path is None else path.at(midi))
    if fields is not None:
        note = note._replace(modal_response=guess_response(note, midi, keyboard_string_law(laws, midi), fields))
    gain = 10 ** ((values["level"] - stroke_level(note)) / 20)
    return note._replace(gain=math.copysign(gain, like.note.gain))


def _warnings(keys: Sequence[KeyFit], posterior: KeyboardPosterior) -> list[str]:
    warnings = [
        f"{midi_to_note(key.midi)}: {name} lies {abs(z):.1f} standard deviations {'above' if z > 0 else 'below'} the "
        "prediction of the other keys"
        for q, name in enumerate(law_quantities(keys[0].law))
        for key, z in zip(keys, posterior.z[q], strict=True)
        if abs(z) > NAMED_SD and len(keys) >= ENOUGH_KEYS
    ]
    for key, shares in zip(keys, posterior.shares, strict=True):
        best = int(np.argmax(shares))
        if best and shares[best] > DECIDED:
            warnings.append(
                f"{midi_to_note(key.midi)}: the other keys agree with minimum {best + 1} of its fit "
                f"({100 * shares[best]:.0f} %), and not with the first"
            )
    unconverged = [midi_to_note(key.midi) for key in keys if not key.summary.converged]
    if unconverged:
        warnings.append(f"The fits of {', '.join(unconverged)} did not converge; their intervals are doubled.")
    if len(keys) < ENOUGH_KEYS:
        warnings.append(
            f"Only {counted(len(keys), 'key')} of this instrument {'are' if len(keys) > 1 else 'is'} "
            f"fitted. The shape of the laws comes from {'the literature' if keys[0].law.key_quantities else 'priors'}."
        )
    return warnings
