"""The data of the page: every table, and the points of every figure, by file name."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ...parameters import FIT_NAMES, HAMMER_NAMES, STRING_NAMES
from ..laboratory import FINAL, INITIAL, SyntheticMeasurement, chosen
from .band3 import PLANE_AXES
from .claims import SPANS
from .strokes import RECIPES, SOUNDS, values_of
from .studies import PRINTED, STRINGS, Findings

__all__ = ["Table", "tables"]

BANDS = ("global", "band1", "band2", "band3")


class Table(NamedTuple):
    """Rows with named columns."""

    columns: tuple[str, ...]
    rows: list[tuple[Any, ...]]


def tables(f: Findings) -> dict[str, Table]:
    """Return all tables by file name."""
    return {"chosen": _chosen(f)} | _direct(f) | _parameters(f) | _band3(f) | _sounds(f) | _others(f) | _limits(f)


def _chosen(f: Findings) -> Table:
    """Values that the paper does not give."""
    g, lab = FINAL.geometry, SyntheticMeasurement()
    rows = [
        ("string mass, kg", g.mass, "steel wire of 1 mm"),
        ("strike position x₀, m", g.strike_position, "usual share of the length"),
        ("width of the contact window, m", g.width, "arbitrary"),
        ("pickup position, m", g.pickup, "not near a node of the first partials"),
        ("initial κ, m²/s", float(INITIAL.string.kappa), "final value: Table II has no initial value"),
        ("length of the signals, s", f.plan.seconds, "arbitrary"),
        ("sampling rate, Hz", chosen.RATE, "common; the paper mentions a digital tape"),
        ("contact steps of the laboratory, Hz, at least", f.plan.contact_rate, "far higher than in a fit"),
        ("second polarisation: angle, degrees", chosen.ANGLE, "aftersound at a level common for pianos"),
        ("second polarisation: detuning, cents", chosen.CENTS, "slow beating"),
        ("bridge: number of resonators", len(chosen.RESONATORS), "add one to two times b₁ to some decay rates"),
        ("relaxing felt: share ε", lab.eps, "same loss as the paper's μ"),
        ("relaxing felt: time τ, s", lab.tau, "long enough to affect reflections"),
        ("noise, dB below the level of the first second", lab.noise_db, "white, with some 1/f"),
        ("sensor of the hammer velocity: relative error", lab.velocity_error, "standard deviation"),
    ]
    return Table(("what", "value", "why"), rows)


def _direct(f: Findings) -> dict[str, Table]:
    """Figures 2 to 4."""
    contact = [(s.velocity, *row) for s in f.strikes for row in zip(s.time, s.force, s.compression, strict=True)]
    spectra = [(s.velocity, *row) for s in f.strikes for row in zip(s.frequency, s.level, strict=True)]
    rows = [(s.velocity, s.contact, s.force.max(), s.compression.max(), s.loop, s.centroid) for s in f.strikes]
    columns = ("velocity_m_s", "contact_s", "largest_force_N", "largest_compression_m", "loop_J", "centroid_Hz")
    return {
        "figure-2-3": Table(("velocity_m_s", "time_s", "force_N", "compression_m"), contact),
        "figure-4": Table(("velocity_m_s", "frequency_Hz", "level_dB"), spectra),
        "strikes": Table(columns, rows),
    }


def _parameters(f: Findings) -> dict[str, Table]:
    """Tables II and III, the weights of the partials in the criterion, and the intervals of the default recipe."""
    fits = {f"{lab}: {RECIPES[r]}": result for lab, stroke in f.tables.items() for r, result in stroke.results.items()}
    values = {f"paper: {column}": printed for column, printed in PRINTED.items()} | {"truth": f.true}
    values |= {column: values_of(result) for column, result in fits.items()}
    own = {column: fits[column].parameters for column in fits if column.endswith(RECIPES["default"])}
    ends = [f"{column}, {end}" for column in own for end in ("from", "to")]
    within = [(p, *(x for table in own.values() for x in (table[p].interval or (None, None)))) for p in FIT_NAMES]
    shares = [(band, k, share) for band, by_partial in f.origin.shares().items() for k, share in by_partial.items()]
    return {
        name: Table(("parameter", *values), [(p, *(column.get(p) for column in values.values())) for p in parameters])
        for name, parameters in (("table-2", STRING_NAMES), ("table-3", HAMMER_NAMES))
    } | {
        "shares": Table(("band", "partial", "share"), shares),
        "intervals": Table(("parameter", *ends), within),
    }  # fmt: skip


def _band3(f: Findings) -> dict[str, Table]:
    """The criterion over the plane, and the ends of the searches."""
    plane, ends = f.plane, f.search_comparison.ends
    grid = [(a, b, plane.criterion[i, j]) for i, a in enumerate(plane.first) for j, b in enumerate(plane.second)]
    return {
        "band-3": Table((*(f"log_{name}_over_true" for name in PLANE_AXES), "criterion"), grid),
        "searches": Table((*ends,), [*zip(*ends.values(), strict=True)]),
    }


def _sounds(f: Findings) -> dict[str, Table]:
    """Figures 6 and 7, and the comparison of every sound with the measured one."""
    wave, shown = f.strokes[f.plan.waveform], ("measured", "initial", *STRINGS)
    rate, count = wave.recording.rate, int(SPANS[-1][1] * wave.recording.rate)
    waves = zip(np.arange(count) / rate, *(wave.sounds[name][:count] for name in shown), strict=True)
    (partial, three), (_, read) = (f.origin.level_differences(f.origin.sounds[recipe]) for recipe in STRINGS)
    near = [
        (v, SOUNDS[name], c.attack, c.centroid, c.level_db, *(c.criterion[band] for band in BANDS))
        for v, stroke in f.strokes.items()
        for name, c in ((name, stroke.closeness[name]) for name in ("measured", "initial", "global", *STRINGS))
    ]
    over = (f"{SOUNDS[recipe]}, dB over measured" for recipe in STRINGS)
    return {
        "figure-7": Table(("time_s", *(SOUNDS[name] for name in shown)), [*waves]),
        "figure-6": Table(("partial", *over), [*zip(partial.tolist(), three, read, strict=True)]),
        "descriptors": Table(("velocity_m_s", "sound", "attack_s", "centroid_Hz", "levels_dB", *BANDS), near),
    }


def _others(f: Findings) -> dict[str, Table]:
    """Predictions, repeated measurements, and effects that the model does not describe."""
    kinds = ("initial", "nearest", *STRINGS)
    predicted = [(v, *(one.closeness[kind].level_db for kind in kinds)) for v, one in f.predictions.items()]
    repeated = [(recipe, *(row[name] for name in FIT_NAMES)) for recipe in STRINGS for row in f.repeated[recipe]]
    effects = [
        (name, recipe, *(c.criterion[band] for band in BANDS), c.level_db)
        for name, stroke in f.effects.items()
        for recipe, c in ((recipe, stroke.closeness[recipe]) for recipe in f.plan.effect_recipes)
    ]
    return {
        "predictions": Table(("velocity_m_s", *kinds), predicted),
        "repeated": Table(("recipe", *FIT_NAMES), repeated),
        "effects": Table(("effect", "recipe", *BANDS, "levels_dB"), effects),
    }


def _limits(f: Findings) -> dict[str, Table]:
    """Bias of κ and sensitivity to b2."""
    columns = ("kind", "points", "rate_Hz", "first", "last", "c_m_s", "kappa_m2_s", "kappa_true_m2_s", "rms_cents")
    b2, criterion = f.b2_sensitivity.b2, f.b2_sensitivity.criterion
    return {
        "kappa": Table(columns, [tuple(fit) for fits in f.dispersion_errors.values() for fit in fits]),
        "b2": Table(("b2_m2_s", *criterion), [*zip(b2, *criterion.values(), strict=True)]),
    }
