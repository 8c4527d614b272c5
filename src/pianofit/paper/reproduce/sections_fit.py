"""Sections of the page: before and after, three bands against one criterion, and what remains."""

from __future__ import annotations

from ...parameters import FIT_NAMES
from ...report.words import number
from . import figures_fit
from .findings import Findings
from .fits import RECIPES, level_differences, rms
from .page import Book, Picture, Section, Sheet
from .sections_search import READ_INSTEAD
from .studies import STRINGS, spread_of
from .verdict import Verdict, or_else
from .verdicts_fit import explained, high_partials_differ, predicts, repeats, three_bands_better, waveforms_nearer

__all__ = ["compared", "remaining", "results"]

SEVENTH = 7  # the paper's "first seven components"
SPANS = ((0.0, 0.015), (0.040, 0.055))  # s, of Figure 7
THREE, READ, WHOLE = RECIPES["paper"], RECIPES["read"], RECIPES["global"]
SHOWN = ("measured", "initial", WHOLE, THREE, READ)
BANDS = {"global": "all bands", "band1": "band 1", "band2": "band 2", "band3": "band 3"}


def results(book: Book, f: Findings) -> Section:
    """Figures 6 and 7."""
    wave = f.waveform
    _result_files(book, f)
    return Section(
        "results",
        "Figures 6 and 7: before and after",
        [
            or_else(*READ_INSTEAD, *(_partials(f, name) for name in (THREE, READ))),
            book.draw("figure-6", lambda: figures_fit.spectra(f.origin), velocity=number(f.plan.origin)),
            or_else(*READ_INSTEAD, *(_waveform(f, name) for name in (THREE, READ))),
            book.draw("figure-7", lambda: figures_fit.waveforms(wave, SPANS), velocity=number(f.plan.waveform)),
        ],
    )


def _partials(f: Findings, name: str) -> Verdict:
    """What Figure 6 shows, of one of the sounds."""
    partial, off = level_differences(f.origin.sounds[name], f.origin.case)
    high = off[partial > SEVENTH]
    return high_partials_differ(rms(off[partial <= SEVENTH]), rms(high), float(high.mean()))


def _waveform(f: Findings, name: str) -> Verdict:
    """What Figure 7 shows, of one of the sounds."""
    shown = {n: f.waveform.sounds[n][: _shown(f)] for n in ("measured", "initial", name)}
    size = rms(shown["measured"])
    before, after = (rms(shown[n] - shown["measured"]) / size for n in ("initial", name))
    return waveforms_nearer(before, after)


def _shown(f: Findings) -> int:
    """Samples up to where Figure 7 ends."""
    return int(SPANS[-1][1] * f.waveform.case.recording.rate)


def _result_files(book: Book, f: Findings) -> None:
    names, rate = ("measured", "initial", THREE, READ), f.waveform.case.recording.rate
    waves = zip(*(f.waveform.sounds[name][: _shown(f)] for name in names), strict=True)
    book.tabulate("figure-7", ("time_s", *names), [(n / rate, *map(float, row)) for n, row in enumerate(waves)])
    partial, three = level_differences(f.origin.sounds[THREE], f.origin.case)
    read = level_differences(f.origin.sounds[READ], f.origin.case)[1]
    rows = list(zip(partial.tolist(), three.tolist(), read.tolist(), strict=True))
    book.tabulate("figure-6", ("partial", f"{THREE}, dB over measured", f"{READ}, dB over measured"), rows)


def compared(book: Book, f: Findings) -> Section:
    """Attack and centroid; other velocities; repeated measurements."""
    velocities = [blow.case.velocity for blow in f.blows]
    return Section(
        "compared",
        "Three bands or one criterion: attack and brightness",
        [
            or_else(*READ_INSTEAD, *(three_bands_better(_errors(f, name), velocities) for name in (THREE, READ))),
            book.draw("descriptors", lambda: figures_fit.descriptors(f.blows)),
            _closeness(book, f),
            *_others(book, f),
            *_again(book, f),
        ],
    )


def _errors(f: Findings, three: str) -> dict[str, dict[str, list[float]]]:
    """Relative errors of attack time and centroid over velocities, of a three-band fit and of the global criterion."""

    def off(measure: str, name: str) -> list[float]:
        return [getattr(b.closeness[name], measure) / getattr(b.closeness["measured"], measure) - 1 for b in f.blows]

    return {measure: {THREE: off(measure, three), WHOLE: off(measure, WHOLE)} for measure in ("attack", "centroid")}


def _closeness(book: Book, f: Findings) -> Sheet:
    """How near every sound comes to what was measured."""
    near = [(blow.case.velocity, name, blow.closeness[name]) for blow in f.blows for name in SHOWN]
    rows = [(v, name, c.attack, c.centroid, c.level_db, *(c.criterion[b] for b in BANDS)) for v, name, c in near]
    file = book.tabulate("descriptors", ("velocity_m_s", "sound", "attack_s", "centroid_Hz", "levels_dB", *BANDS), rows)
    shown = [
        (number(v), name, number(1e3 * attack, 3), number(centre, 4), *(number(x, 2) for x in rest))
        for v, name, attack, centre, *rest in rows
    ]
    titles = ("m/s", "sound", "attack, ms", "centroid, Hz", "levels off by, dB", *BANDS.values())
    caption = "How near each sound comes to the measured one. Criteria: 0 for equal spectra, 1 for silence."
    return Sheet(file, caption, titles, shown, words=(0, 1))


def _others(book: Book, f: Findings) -> list[Verdict | Picture]:
    """Velocities that were not fitted."""
    done, origin = f.predictions, f.plan.origin
    by = {kind: [getattr(one, kind).level_db for one in done] for kind in ("initial", "nearest")}
    by |= {recipe: [one.predicted[recipe].level_db for one in done] for recipe in STRINGS}
    velocities = [one.velocity for one in done]
    book.tabulate("predictions", ("velocity_m_s", *by), list(zip(velocities, *by.values(), strict=True)))
    said = [predicts(velocities, origin, by[recipe], by["initial"], by["nearest"]) for recipe in STRINGS]
    return [
        or_else(*READ_INSTEAD, *said),
        book.draw("predictions", lambda: figures_fit.predicted_levels(by, velocities, origin)),
    ]


def _again(book: Book, f: Findings) -> list[Verdict | Picture]:
    """Repeated measurements."""
    by, true = f.repeated, f.origin.case.measurement.true
    rows = [(recipe, *(row[name] for name in FIT_NAMES)) for recipe in STRINGS for row in by[recipe]]
    book.tabulate("repeated", ("recipe", *FIT_NAMES), rows)
    named = {RECIPES[recipe]: by[recipe] for recipe in STRINGS}
    return [
        or_else(*READ_INSTEAD, *(repeats(spread_of(by[recipe]), f.plan.repeats) for recipe in STRINGS)),
        book.draw(
            "repeated",
            lambda: figures_fit.repeated_values(named, true, f.tables.printed_final),
            count=f.plan.repeats,
        ),
    ]


def remaining(book: Book, f: Findings) -> Section:
    """What the model lacks, one by one."""
    done, recipes = f.effects, {recipe: RECIPES[recipe] for recipe in f.plan.effect_recipes}
    rows = [(one.name, r, *(one.remains[r][b] for b in BANDS), one.level_db[r]) for one in done for r in recipes]
    file = book.tabulate("effects", ("effect", "recipe", *BANDS, "levels_dB"), rows)
    shown = [(effect, recipes[recipe], *(number(x, 2) for x in rest)) for effect, recipe, *rest in rows]
    titles = ("the laboratory's effect", "fitted by", *BANDS.values(), "levels off by, dB")
    said = [_explained(f, recipe) for recipe in STRINGS]
    return Section(
        "remaining",
        "What remains, and why",
        [
            or_else(*READ_INSTEAD, *said),
            book.draw("effects", lambda: figures_fit.remains(done, recipes), velocity=number(f.plan.origin)),
            Sheet(file, "What remains, in numbers.", titles, shown, words=(0, 1)),
        ],
    )


def _explained(f: Findings, recipe: str) -> Verdict:
    left = {one.name: one.remains[recipe]["band3"] for one in f.effects}
    everything, nothing = left.pop("all"), left.pop("none")
    return explained(left, everything, nothing)
