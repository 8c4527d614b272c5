"""What the distance between a guessed key and its recordings consists of.

    python benchmarks/unrecorded_parts.py FITS RECORDINGS [--prefix headroom]

Every inner key is left out in turn, as by `unrecorded.py`. Then parts of its guess are replaced by those of its own
fit, one after another. The columns are distances from the recordings (`../shared/tools/realism.py`), dB, mean over the
layers of a key:

    guess         the guess of the instrument
    levels        with the own level of every partial
    decays        also with its own decay, without beats
    modes         also with its own beats, frequencies, channels and hammer: only the knock is guessed
    own fit       also with its own knock
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from realism import measure
from unrecorded import left_out, rendered

from pianofit.instrument import build_instrument, find_fits, load_keys
from pianofit.instrument.guessed_knocks import static_part
from pianofit.instrument.guessed_responses import fit_exponentials
from pianofit.instrument.measured_fields import decay_curve, expected_force, level_energy, partial_energies, spectrum
from pianofit.model.modal_response import ModalResponse
from pianofit.program_folder import enable_program_cache

COLUMNS = ("guess", "levels", "decays", "modes", "own fit")


def levels(note: Any, velocity: float, numbers: np.ndarray) -> np.ndarray:
    """Level of the energy of partials after a stroke, dB [numbers]."""
    response, force, out = note.modal_response, spectrum(note, velocity), []
    for number in numbers:
        part = response.partial == number
        frequency = np.imag(response.pole[part]).mean(keepdims=True) / (2 * np.pi)
        energy = partial_energies(response, part, np.array([velocity]))[0]
        out.append(10 * np.log10(energy) + 20 * np.log10(abs(note.gain) * expected_force(force, frequency)[0]))
    return np.array(out)


def with_knock_of(response: ModalResponse, other: ModalResponse, ratio: float = 1.0) -> ModalResponse:
    """Return a response with the knock of another one, times a ratio, which cancels its own static deflection."""
    static, own = static_part(response), static_part(other)
    knock = np.zeros_like(own)
    count = min(own.shape[-1], other.knock.shape[-1])
    knock[:, :count] = other.knock[:, :count]
    return response._replace(knock=static + ratio * np.resize(knock - own, static.shape))


def with_levels(guess: Any, own: Any, velocity: float, numbers: np.ndarray) -> ModalResponse:
    """The guessed response with the levels of the own partials."""
    response, size = guess.modal_response, np.ones(len(guess.modal_response.pole))
    change = levels(own, velocity, numbers) - levels(guess, velocity, numbers)
    for number, db in zip(numbers, change, strict=True):
        size[response.partial == number] = 10 ** (db / 20)
    return with_knock_of(response._replace(pattern=response.pattern * size), response)


def with_decays(response: ModalResponse, own: ModalResponse, numbers: np.ndarray) -> ModalResponse:
    """The response with the decays of the own partials, two exponentials each; its levels stay."""
    kept, poles, patterns = [], [], []
    for number in numbers:
        part = own.partial == number
        rate = -float(np.median(np.real(own.pole[part])))
        power = decay_curve(own, own.pattern.mean(axis=0), part, rate)
        curve = 10 * np.log10(np.maximum(power, 1e-12 * power.max()))
        share, ratio = (row[0] for row in fit_exponentials((curve - curve[0])[None]))
        decay, share = ratio[share > 0] * rate, share[share > 0]
        first = np.flatnonzero(response.partial == number)[0]
        energy = share @ level_energy(decay[:, None] + decay) @ share
        wanted = partial_energies(response._replace(velocity_gain=None), response.partial == number, np.ones(1))[0]
        phasor = response.pattern[:, first] / abs(response.pattern[:, first].mean())
        kept += [first] * len(decay)
        poles += (-decay + 1j * np.imag(response.pole[first])).tolist()
        patterns += [phasor * s * np.sqrt(wanted / energy) for s in share]
    gain = response.velocity_gain
    changed = response._replace(
        partial=response.partial[kept],
        pole=np.array(poles),
        pole_error=response.pole_error[kept],
        pattern=np.array(patterns).T,
        velocity_gain=gain and gain._replace(factor=gain.factor[:, kept]),
    )
    return with_knock_of(changed, response)


def notes(guess: Any, own: Any, velocity: float) -> dict[str, Any]:
    """The guess, in which one part after another is replaced by that of the own fit."""
    ours = own.modal_response.at(guess.modal_response.rate)
    own = own._replace(modal_response=ours)
    numbers = np.intersect1d(guess.modal_response.partial, ours.partial[ours.partial > 0])
    level = with_levels(guess, own, velocity, numbers)
    parts = {
        "guess": guess,
        "levels": guess._replace(modal_response=level),
        "decays": guess._replace(modal_response=with_decays(level, ours, numbers)),
        "modes": own._replace(modal_response=with_knock_of(ours, guess.modal_response, abs(guess.gain / own.gain))),
        "own fit": own,
    }
    return {name: parts[name] for name in COLUMNS}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("fits", type=Path)
    parser.add_argument("recordings", type=Path)
    parser.add_argument("--prefix")
    options = parser.parse_args()
    enable_program_cache()
    tool: Any = measure()
    files = {file.name: file for file in options.recordings.rglob("*") if file.is_file()}
    keys = load_keys(find_fits([options.fits], options.prefix))
    whole, rows = build_instrument(keys), []
    print(f"{'':16}" + "".join(f"{column:>10}" for column in COLUMNS) + "   dB", flush=True)
    for (key,) in left_out(keys):
        guess = build_instrument([other for other in keys if other is not key]).keys[key.midi].note
        own, found = whole.keys[key.midi], []
        for layer in own.fit.layers if own.fit else ():
            target = tool.load(str(files[Path(layer.file).name]))
            tried = notes(guess, own.note, layer.velocity).values()
            found.append([tool.compare(target, rendered(tool, x, layer.velocity))["distance_db"] for x in tried])
        rows.append(np.mean(found, axis=0))
        name = Path(key.summary.file).parent.name
        print(f"{name:16}" + "".join(f"{value:10.2f}" for value in rows[-1]), flush=True)
    print(f"{'mean':16}" + "".join(f"{value:10.2f}" for value in np.mean(rows, axis=0)))


if __name__ == "__main__":
    main()
