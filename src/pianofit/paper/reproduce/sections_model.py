"""Sections of the page: what was chosen, the direct problem, and the limits of κ and b2."""

from __future__ import annotations

import numpy as np

from ...report.words import number
from ..laboratory import Laboratory, chosen
from . import figures_direct, figures_search
from .findings import Findings
from .fits import RECIPES
from .limits import Bend
from .page import Book, Paragraph, Section, Sheet
from .verdict import Verdict
from .verdicts_model import b2_seen, bends_kappa, brighter, contact_lasts, contact_shortens, felt_loses, reflections

__all__ = ["choices", "limits", "problem"]

LABORATORIES = (
    "“Full laboratory” means a measurement with all of this: a second polarisation, a bridge that yields, a felt with "
    "memory, noise, and a sensor that reads the hammer's velocity a few per cent wrong. “Ideal laboratory” means the "
    "paper's own model and noise. Both are computed by code that shares nothing with the model that is fitted. The "
    "values are invented: what is found here says how far a fit can be trusted when its model is wrong in such ways, "
    "not how wrong it is about a real string."
)
PROCESSES = (
    "“{paper}” is the paper's process: c and b₁ in band 1, κ and b₂ in band 2, both by gradient, then K_H, μ, M_H, p "
    "and v₀ in band 3 by annealing (the better of {tries}, but for repeated measurements). “{read}” is its third step "
    "alone, on a string that was read off the frequencies and decays of the partials, and is held: it shows what the "
    "hammer's step is worth when the string is right. “{global}” is equation 19 over the whole spectrum, all nine by "
    "gradient. “{default}” is what pianofit does unless told otherwise: it compares partials' frequencies, decays and "
    "levels, weighted by their noise. All start from the paper's initial values, but for what is read."
)


def choices(book: Book, f: Findings) -> Section:
    """What the paper does not give."""
    g, lab = chosen.FINAL.geometry, Laboratory()
    rows = [
        ("mass of the string, kg", g.mass, "a steel wire of 1 mm"),
        ("strike position x₀, m", g.strike, "the usual share of the length"),
        ("width of the contact, m", g.width, "chosen once"),
        ("pickup position, m", g.pickup, "near no node of the first partials"),
        ("initial κ, m²/s", float(chosen.INITIAL.string.kappa), "the final one: Table II has no other"),
        ("length of the signals, s", chosen.SECONDS, "chosen once"),
        ("sampling rate, Hz", chosen.RATE, "a common one; the paper names a digital tape"),
        ("steps of the laboratory's contact, Hz, at least", chosen.CONTACT_RATE, "far above any fit's"),
        ("second polarisation: turned by, degrees", chosen.ANGLE, "an aftersound as pianos often have"),
        ("second polarisation: sharp by, cents", chosen.CENTS, "slow beats"),
        ("bridge: resonators", len(chosen.RESONATORS), "some partials decay faster by once or twice b₁"),
        ("felt's memory: share ε", lab.eps, "loses what the paper's μ does"),
        ("felt's memory: time τ, s", lab.tau, "long enough to be felt by reflections"),
        ("noise, dB below the first second's level", lab.noise_db, "white, with some 1/f"),
        ("sensor of the hammer's velocity: error, relative", lab.velocity_error, "standard deviation"),
    ]
    shown = [(what, number(float(value)), why) for what, value, why in rows]
    file = book.tabulate("chosen", ("what", "value", "why"), rows)
    caption = "What the paper does not give, and what stands for it here. The string is 1 m long, as the paper's."
    table = Sheet(file, caption, ("what", "value", "why"), shown, words=(0, 2))
    names = {recipe: name.capitalize() for recipe, name in RECIPES.items()}
    processes = PROCESSES.format(**names, tries=f.plan.tries)
    return Section("chosen", "What was chosen", [Paragraph(LABORATORIES), Paragraph(processes), table])


def problem(book: Book, f: Findings) -> Section:
    """Figures 2 to 4."""
    blows, hardest = f.strikes, f.strikes[-1]
    velocity, contact = [b.velocity for b in blows], [b.contact for b in blows]
    text = (
        "Note and hammer are those of Chaigne and Askenfelt's C4, as in the paper, which names two of the velocities."
    )
    _contact_files(book, f)
    return Section(
        "direct",
        "Figures 2 to 4: the model by itself",
        [
            Paragraph(text),
            contact_lasts(velocity, contact, f.hammer_mass, f.needed_mass),
            contact_shortens(velocity, contact),
            reflections(velocity, [b.humps for b in blows], f.trip),
            book.draw("figure-2", lambda: figures_direct.force_over_time(blows, f.trip)),
            felt_loses(hardest.loop, hardest.balance, hardest.hammer_energy),
            book.draw(
                "figure-3",
                lambda: figures_direct.force_over_compression(hardest),
                velocity=number(hardest.velocity),
                mu=number(hardest.mu),
            ),
            brighter(velocity, [b.centroid for b in blows]),
            book.draw("figure-4", lambda: figures_direct.velocity_spectra(blows)),
            _strikes(book, f),
        ],
    )


def _contact_files(book: Book, f: Findings) -> None:
    """Write the curves of Figures 2 to 4."""
    contact = [
        (b.velocity, *map(float, row)) for b in f.strikes for row in zip(b.time, b.force, b.compression, strict=True)
    ]
    spectra = [(b.velocity, *map(float, row)) for b in f.strikes for row in zip(b.frequency, b.level, strict=True)]
    book.tabulate("figure-2-3", ("velocity_m_s", "time_s", "force_N", "compression_m"), contact)
    book.tabulate("figure-4", ("velocity_m_s", "frequency_Hz", "level_dB"), spectra)


def _strikes(book: Book, f: Findings) -> Sheet:
    rows = [
        (b.velocity, b.contact, float(b.force.max()), float(b.compression.max()), b.loop, b.centroid) for b in f.strikes
    ]
    header = ("velocity_m_s", "contact_s", "largest_force_N", "largest_compression_m", "loop_J", "centroid_Hz")
    file = book.tabulate("strikes", header, rows)
    shown = [
        tuple(number(x * scale, 3) for x, scale in zip(row, (1, 1e3, 1, 1e3, 1e3, 1), strict=True)) for row in rows
    ]
    titles = ("velocity, m/s", "contact, ms", "largest force, N", "compression, mm", "felt's loss, mJ", "centroid, Hz")
    return Sheet(file, "A C4 struck at three velocities.", titles, shown)


def limits(book: Book, f: Findings) -> Section:
    """κ and b2."""
    worst = f.bends["fitted to band 2"][0]
    return Section(
        "limits",
        "What κ and b₂ mean",
        [
            bends_kappa(worst.kappa_true, worst.kappa, f.inverse.kappa, worst.points, worst.rate),
            book.draw("kappa", lambda: figures_search.kappa_by_grid(f.bends)),
            _bends(book, f),
            _b2_verdict(book, f),
            book.draw("b2", lambda: figures_search.b2_over_decades(f.blindness)),
        ],
    )


def _bends(book: Book, f: Findings) -> Sheet:
    every = [bend for bends in f.bends.values() for bend in bends]
    header = ("kind", "points", "rate_Hz", "first", "last", "c_m_s", "kappa_m2_s", "kappa_true_m2_s", "rms_cents")
    rows = [(b.kind, b.points, b.rate, *b.partials, b.c, b.kappa, b.kappa_true, b.rms_cents) for b in every]
    titles = ("scheme", "partials", "c, m/s", "κ, m²/s", "off by", "left over, cents rms")
    caption = "κ through the paper's grid and step, and through prewarped modes."
    return Sheet(book.tabulate("kappa", header, rows), caption, titles, [_bend(b) for b in every], words=(0, 1))


def _bend(b: Bend) -> tuple[str, ...]:
    scheme = "prewarped modes" if b.kind == "continuous" else f"N = {b.points}, {number(1e-3 * b.rate)} kHz"
    off = f"{100 * b.off:+.1f} %".replace("-", "−")
    return scheme, f"{b.partials[0]} to {b.partials[1]}", f"{b.c:.3f}", f"{b.kappa:.4f}", off, f"{b.rms_cents:.2f}"


def _b2_verdict(book: Book, f: Findings) -> Verdict:
    seen, band = f.blindness, "band2"
    rows = [(float(b2), *(float(by[n]) for by in seen.criterion.values())) for n, b2 in enumerate(seen.b2)]
    book.tabulate("b2", ("b2_m2_s", *seen.criterion), rows)
    curve = seen.criterion[band]
    at = float(np.interp(np.log(seen.true), np.log(seen.b2), curve))
    above = np.flatnonzero((curve - at > seen.spread[band]) & (seen.b2 > seen.true))
    visible = float(seen.b2[above[0]]) if above.size else None
    remains = f.origin.closeness[RECIPES["paper"]].criterion[band]
    return b2_seen(seen.true, abs(at - float(curve[0])), seen.spread[band], remains, visible, float(seen.b2[-1]))
