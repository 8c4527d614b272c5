"""The numbers behind the page: every table, and the points of every figure, with all their digits."""

from __future__ import annotations

from ...parameters import FIT_NAMES, HAMMER_NAMES, STRING_NAMES
from ..laboratory import Laboratory, chosen
from .book import Book
from .cases import RECIPES, level_differences, shares
from .judged import SPANS, THREE, WHOLE
from .studies import STRINGS, Findings

__all__ = ["write_tables"]

READ = RECIPES["read"]
SHOWN = ("measured", "initial", WHOLE, THREE, READ)
BANDS = ("global", "band1", "band2", "band3")


def write_tables(book: Book, f: Findings) -> None:
    """Write all of them."""
    for write in (_chosen, _direct, _parameters, _band3, _results, _closeness, _others, _limits):
        write(book, f)


def _chosen(book: Book, f: Findings) -> None:
    """What the paper does not give."""
    g, lab = chosen.FINAL.geometry, Laboratory()
    rows = [
        ("mass of the string, kg", g.mass, "a steel wire of 1 mm"),
        ("strike position x₀, m", g.strike, "the usual share of the length"),
        ("width of the contact, m", g.width, "chosen once"),
        ("pickup position, m", g.pickup, "near no node of the first partials"),
        ("initial κ, m²/s", float(chosen.INITIAL.string.kappa), "the final one: Table II has no other"),
        ("length of the signals, s", f.plan.seconds, "chosen once"),
        ("sampling rate, Hz", chosen.RATE, "a common one; the paper names a digital tape"),
        ("steps of the laboratory's contact, Hz, at least", f.plan.contact_rate, "far above any fit's"),
        ("second polarisation: turned by, degrees", chosen.ANGLE, "an aftersound as pianos often have"),
        ("second polarisation: sharp by, cents", chosen.CENTS, "slow beats"),
        ("bridge: resonators", len(chosen.RESONATORS), "some partials decay faster by once or twice b₁"),
        ("felt's memory: share ε", lab.eps, "loses what the paper's μ does"),
        ("felt's memory: time τ, s", lab.tau, "long enough to be felt by reflections"),
        ("noise, dB below the first second's level", lab.noise_db, "white, with some 1/f"),
        ("sensor of the hammer's velocity: error, relative", lab.velocity_error, "standard deviation"),
    ]
    book.tabulate("chosen", ("what", "value", "why"), rows)


def _direct(book: Book, f: Findings) -> None:
    """Figures 2 to 4."""
    contact = [
        (s.velocity, *map(float, row)) for s in f.strikes for row in zip(s.time, s.force, s.compression, strict=True)
    ]
    spectra = [(s.velocity, *map(float, row)) for s in f.strikes for row in zip(s.frequency, s.level, strict=True)]
    book.tabulate("figure-2-3", ("velocity_m_s", "time_s", "force_N", "compression_m"), contact)
    book.tabulate("figure-4", ("velocity_m_s", "frequency_Hz", "level_dB"), spectra)
    rows = [
        (s.velocity, s.contact, float(s.force.max()), float(s.compression.max()), s.loop, s.centroid) for s in f.strikes
    ]
    columns = ("velocity_m_s", "contact_s", "largest_force_N", "largest_compression_m", "loop_J", "centroid_Hz")
    book.tabulate("strikes", columns, rows)


def _parameters(book: Book, f: Findings) -> None:
    """Tables II and III, what rules the criterion, and what the default recipe says of its own certainty."""
    t = f.tables
    columns = {"paper: initial": t.printed_initial, "paper: final": t.printed_final, "truth": t.true} | t.found
    for name, parameters in (("table-2", STRING_NAMES), ("table-3", HAMMER_NAMES)):
        rows = [(p, *(column.get(p) for column in columns.values())) for p in parameters]
        book.tabulate(name, ("parameter", *columns), rows)
    every = [(band, k, share) for band, by in shares(f.origin.case).items() for k, share in by.items()]
    book.tabulate("shares", ("band", "partial", "share"), every)
    ends = [f"{column}, {end}" for column in t.intervals for end in ("from", "to")]
    rows = [(p, *(x for by in t.intervals.values() for x in (by[p] or (None, None)))) for p in FIT_NAMES]
    book.tabulate("intervals", ("parameter", *ends), rows)


def _band3(book: Book, f: Findings) -> None:
    """The landscape, and where the searches ended."""
    plane, run = f.plane, f.race
    grid = [
        (float(a), float(b), float(plane.criterion[i, j]))
        for i, a in enumerate(plane.first)
        for j, b in enumerate(plane.second)
    ]
    book.tabulate("band-3", (*(f"log_{name}_over_true" for name in plane.names), "criterion"), grid)
    kinds = ("gradient", "squares", "annealed", "polished")
    ends = zip(run.start, *(getattr(run, kind) for kind in kinds), strict=True)
    book.tabulate("searches", ("start", *kinds), [tuple(map(float, row)) for row in ends])


def _results(book: Book, f: Findings) -> None:
    """Figures 6 and 7."""
    names, wave = ("measured", "initial", THREE, READ), f.at(f.plan.waveform)
    rate = wave.case.recording.rate
    waves = zip(*(wave.sounds[name][: int(SPANS[-1][1] * rate)] for name in names), strict=True)
    book.tabulate("figure-7", ("time_s", *names), [(n / rate, *map(float, row)) for n, row in enumerate(waves)])
    partial, three = level_differences(f.origin.sounds[THREE], f.origin.case)
    read = level_differences(f.origin.sounds[READ], f.origin.case)[1]
    rows = list(zip(partial.tolist(), three.tolist(), read.tolist(), strict=True))
    book.tabulate("figure-6", ("partial", f"{THREE}, dB over measured", f"{READ}, dB over measured"), rows)


def _closeness(book: Book, f: Findings) -> None:
    """How near every sound comes to what was measured."""
    near = [(stroke.case.velocity, name, stroke.closeness[name]) for stroke in f.strokes for name in SHOWN]
    rows = [(v, name, c.attack, c.centroid, c.level_db, *(c.criterion[b] for b in BANDS)) for v, name, c in near]
    book.tabulate("descriptors", ("velocity_m_s", "sound", "attack_s", "centroid_Hz", "levels_dB", *BANDS), rows)


def _others(book: Book, f: Findings) -> None:
    """Velocities that were not fitted, repeated measurements, and what the model lacks."""
    done = f.predictions
    rows = [
        (p.velocity, p.initial.level_db, p.nearest.level_db, *(p.predicted[r].level_db for r in STRINGS)) for p in done
    ]
    book.tabulate("predictions", ("velocity_m_s", "initial", "nearest", *STRINGS), rows)
    rows = [(recipe, *(row[name] for name in FIT_NAMES)) for recipe in STRINGS for row in f.repeated[recipe]]
    book.tabulate("repeated", ("recipe", *FIT_NAMES), rows)
    rows = [
        (one.name, r, *(one.remains[r][b] for b in BANDS), one.level_db[r])
        for one in f.effects
        for r in f.plan.effect_recipes
    ]
    book.tabulate("effects", ("effect", "recipe", *BANDS, "levels_dB"), rows)


def _limits(book: Book, f: Findings) -> None:
    """κ and b2."""
    columns = ("kind", "points", "rate_Hz", "first", "last", "c_m_s", "kappa_m2_s", "kappa_true_m2_s", "rms_cents")
    every = [b for bends in f.bends.values() for b in bends]
    rows = [(b.kind, b.points, b.rate, *b.partials, b.c, b.kappa, b.kappa_true, b.rms_cents) for b in every]
    book.tabulate("kappa", columns, rows)
    seen = f.blindness
    rows = [(float(b2), *(float(by[n]) for by in seen.criterion.values())) for n, b2 in enumerate(seen.b2)]
    book.tabulate("b2", ("b2_m2_s", *seen.criterion), rows)
