"""Published strings and hammers with their sources, and typical notes interpolated from them.

This project measured none of these values. "Read in the paper" means that the primary table was available.
"Second-hand" means that the values come from published code and could not be compared with the primary table.

Known deviations: the printed frequencies of the strings after Chabassier belong to A4 = 441 Hz, 4 cents above 440 Hz.
The frequencies computed from their tension, density and diameter deviate from them by -2 cents at C#5, -4 at G6 and -9
at C7. The C4 of Chaigne and Askenfelt has 262.2 Hz, 4 cents above 440 Hz tuning. The string of the paper has no note
name; 152.1 Hz is 40 cents below D#3.
"""

import difflib
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from typing import NamedTuple

import numpy as np

from .conversions import HIGHEST_KEY, LOWEST_KEY, hertz_of
from .errors import AnalysisError, ParameterError, check_range
from .monotone_cubic import MonotoneCubic
from .parameters import Geometry, Hammer, String

PAPER = "Bensa, Gipouloux and Kronland-Martinet, J. Acoust. Soc. Am. 118, 495 (2005), Tables II and III"
CHAIGNE = "Chaigne and Askenfelt, J. Acoust. Soc. Am. 95, 1112 and 1631 (1994)"
BENSA_2003 = "Bensa, Bilbao, Kronland-Martinet and Smith, J. Acoust. Soc. Am. 114, 1095 (2003)"
CHABASSIER = "after Chabassier, thesis (2012)"
READ, SECOND_HAND = "read in the paper", "second-hand"
LOWEST_NOTE, HIGHEST_NOTE = 15, 114  # MIDI, half an octave beyond each end of the piano

YOUNG = 2.0e11  # Pa, steel; not in the table after Chabassier
TYPICAL_MU = 0.1  # s/m, initial value of the paper (Table III)
TYPICAL_VELOCITY = 2.0  # m/s, mezzo-forte
STRIKE = 0.12  # x0/L, Chaigne and Askenfelt; the strings after Chabassier have 0.116 to 0.121
PICKUP = 0.30  # x_m/L, away from nodes of the first partials; chosen, not published
# Reference compression over the one that a rigid stop causes. Strings yield: the literature's hammers reach 0.56 to
# 0.92 of it on their own strings, and strokes determine the force at about half of what they reach.
REFERENCE_SHARE = 1 / 3
WIDTH = 0.02  # m, full width of the contact window; chosen, not published


class PublishedString(NamedTuple):
    """Dimensions, density and tension of a string."""

    note: str
    midi: int
    f0: float  # Hz, as printed
    length: float  # m
    diameter: float  # m, of the core
    density: float  # kg/m³, relative to the core volume; values above 7850 include the mass of the winding
    tension: float  # N
    strike: float  # m

    @property
    def mass(self) -> float:
        """M_S, kg."""
        return self.density * math.pi * self.diameter**2 / 4 * self.length

    @property
    def c(self) -> float:
        """Wave speed √(T L/M_S), m/s."""
        return math.sqrt(self.tension * self.length / self.mass)

    @property
    def kappa(self) -> float:
        """κ = √(E I/(ρ A)), m²/s, with I = π d⁴/64 of the core. A winding adds mass, but almost no stiffness."""
        return self.diameter / 4 * math.sqrt(YOUNG / self.density)

    @property
    def B(self) -> float:
        """Inharmonicity κ² π²/(c² L²)."""
        return (self.kappa * math.pi / (self.c * self.length)) ** 2


class PublishedHammer(NamedTuple):
    """Mass and static felt law F = K_H u^p of a whole hammer, which strikes all strings of its note."""

    note: str
    midi: int
    M_H: float  # kg
    p: float
    K_H: float  # N/m^p


class PublishedLoss(NamedTuple):
    """Loss parameters of a string, with decay rates b1 + b2 β²."""

    note: str
    midi: int
    b1: float  # 1/s
    b2: float  # m²/s


# After Chabassier (2012), second-hand.
STRINGS = (
    PublishedString("D#1", 27, 38.98, 1.965, 1.492e-3, 43195.0, 1773.0, 0.236),
    PublishedString("C2", 36, 65.56, 1.602, 1.051e-3, 23919.0, 915.0, 0.192),
    PublishedString("F3", 53, 175.01, 0.960, 1.049e-3, 7850.0, 766.0, 0.115),
    PublishedString("C#5", 73, 555.6, 0.326, 0.928e-3, 7850.0, 695.0, 0.039),
    PublishedString("G6", 91, 1571.35, 0.124, 0.860e-3, 7850.0, 689.0, 0.015),
    PublishedString("C7", 96, 2098.32, 0.095, 0.831e-3, 7850.0, 670.0, 0.011),
)
# After Chabassier (2012), second-hand.
HAMMERS = (
    PublishedHammer("C2", 36, 10.20e-3, 2.276, 3.105e8),
    PublishedHammer("C3", 48, 9.45e-3, 2.312, 1.347e9),
    PublishedHammer("A3", 57, 8.89e-3, 2.385, 4.047e9),
    PublishedHammer("A4", 69, 8.14e-3, 2.543, 1.755e10),
    PublishedHammer("C5", 72, 7.96e-3, 2.593, 2.532e10),
    PublishedHammer("A5", 81, 7.40e-3, 2.771, 7.611e10),
)
# Number of strings of a note over the MIDI number, in grand pianos: from one in the low bass to three. A model of one
# string uses the share of one string in hammer mass and felt force.
STRINGS_PER_KEY = [(21.0, 1.0), (27.0, 1.0), (36.0, 2.0), (53.0, 3.0), (96.0, 3.0)]
# After Chaigne and Askenfelt (1994), second-hand. Share of one string: half of the mass above at C2, a third at C4 and
# C7. Only for comparison with the table.
CHAIGNE_HAMMERS = (
    PublishedHammer("C2", 36, 4.9e-3, 2.3, 4e8),
    PublishedHammer("C4", 60, 2.97e-3, 2.5, 4.5e9),
    PublishedHammer("C7", 96, 2.2e-3, 3.0, 1e11),
)
# After Bensa et al. (2003), second-hand.
LOSSES = (
    PublishedLoss("C2", 36, 0.25, 7.5e-5),
    PublishedLoss("C4", 60, 1.1, 2.7e-4),
    PublishedLoss("C7", 96, 9.17, 2.1e-3),
)


@dataclass(frozen=True)
class Preset:
    """A complete struck string. Every number is published, interpolated, or chosen as `completed` describes."""

    name: str
    note: str | None  # None if the source names no note
    string: String
    hammer: Hammer
    geometry: Geometry
    source: str
    derivation: str
    completed: str  # values missing in the source, and their origin
    interpolated: dict[str, str] = field(default_factory=dict)  # by field: the published rows next to it

    @property
    def f0(self) -> float:
        """Fundamental frequency c/2L, Hz, of the string without stiffness."""
        return float(self.string.c / (2 * self.geometry.length))


def preset(name: str) -> Preset:
    """Return a string and a hammer from the literature.

    Parameters
    ----------
    name : name of a preset, such as "chabassier-F3". The error for an unknown name lists all.

    Returns
    -------
    A `Preset`: string, hammer and geometry in SI units, with their source.

    Raises
    ------
    ParameterError
        If the name is unknown. The message suggests the nearest name and lists all.

    Examples
    --------
    >>> import pianofit
    >>> f3 = pianofit.preset("chabassier-F3")
    >>> f"{f3.note}, {f3.f0:.1f} Hz, hammer {1e3 * f3.hammer.M_H:.1f} g"
    'F3, 175.0 Hz, hammer 3.0 g'
    """
    if isinstance(name, str) and name in PRESETS:
        return PRESETS[name]
    near = difflib.get_close_matches(str(name).lower(), {key.lower(): key for key in PRESETS}, 1)
    hint = f"did you mean {next(key for key in PRESETS if key.lower() == near[0])}? " if near else ""
    raise ParameterError(f"preset={str(name)!r} is unknown; {hint}presets: {', '.join(PRESETS)}")


def typical(note: str | float) -> Preset:
    """Return the typical string and hammer of a key, interpolated from the literature.

    The result describes grand pianos in general, not a particular instrument. Length, tension, inharmonicity, losses,
    strings per key, hammer mass and felt are interpolated over the note number by monotone cubics, on a log scale
    except for p. Mass, c and κ are computed from them, so c = 2 L f0 holds at every note. Beyond its rows the tension
    keeps its last value. The other quantities continue with their last slope: at C7 p is 3.07, while Chaigne and
    Askenfelt have 3.0. Mass and stiffness of the hammer are divided by the number of strings that it strikes. That
    number is one up to D#1, two at C2, three from F3 on, and interpolated between.

    Parameters
    ----------
    note : a name such as "C4" or "F#2", or a MIDI number from 15 to 114, possibly with a fraction.

    Returns
    -------
    A `Preset`. `source` lists the tables. `interpolated` names every interpolated number and the published rows next
    to it. `completed` names the chosen numbers.

    Raises
    ------
    ParameterError
        If the text is not a note, or the note is out of range.

    Examples
    --------
    >>> import pianofit
    >>> c4 = pianofit.typical("C4")
    >>> f"{c4.f0:.1f} Hz, {c4.geometry.length:.2f} m, hammer {1e3 * c4.hammer.M_H:.1f} g"
    '261.6 Hz, 0.69 m, hammer 2.9 g'
    >>> c4.interpolated["M_H"]
    'between A3 and A4'
    """
    return _typical(*_midi(note))


def reference_compression(midi: float) -> float:
    """Return the reference compression of a key, m: every felt force that is reported without another holds there.

    It depends on the key alone, so forces of all fits of a key, and of an instrument, are those of one compression. It
    is `REFERENCE_SHARE` of the compression with which a rigid stop brakes the literature's hammer from
    `TYPICAL_VELOCITY`.

    Parameters
    ----------
    midi : MIDI number or pitch. The nearest key of a piano counts.

    Examples
    --------
    >>> from pianofit.literature import reference_compression
    >>> f"{1e3 * reference_compression(60):.3f} mm"
    '0.203 mm'
    """
    h = typical(float(min(max(round(midi), LOWEST_KEY), HIGHEST_KEY))).hammer
    braked = (0.5 * (h.p + 1) * h.M_H * TYPICAL_VELOCITY**2 / h.K_H) ** (1 / (h.p + 1))
    return float(REFERENCE_SHARE * braked)


def typical_strings(midi: float) -> float:
    """Return the number of strings of a note in grand pianos. Between registers it is not whole."""
    return _curve("strings")(midi)


def _typical(midi: float, name: str) -> Preset:
    f0 = hertz_of(midi)
    at = {name: _curve(name)(midi) for name in TABLES}
    length, c = at["length"], 2 * at["length"] * f0
    kappa = c * length * math.sqrt(at["B"]) / math.pi  # B = κ² π²/(c² L²)
    return Preset(
        name=f"typical-{name}",
        note=name,
        string=String(c, kappa, at["b1"], at["b2"]),
        hammer=Hammer(at["K_H"] / at["strings"], TYPICAL_MU, at["p"], at["M_H"] / at["strings"], TYPICAL_VELOCITY),
        geometry=_geometry(length, at["tension"] * length / c**2),
        source=f"strings and hammers {CHABASSIER}; losses: {BENSA_2003}",
        derivation=SECOND_HAND,
        completed="c: 2 L f0 in equal temperament, A4 = 440 Hz; M_H, K_H: one string's share of a hammer that strikes "
        "one string up to D#1, two at C2, three from F3 on; mu: Bensa et al. (2005), Table III; v_H0, width, pickup: "
        "chosen; strike_position: 0.12 of the length, Chaigne and Askenfelt (1994)",
        interpolated=_interpolated(midi),
    )


def _midi(note: str | float) -> tuple[float, str]:
    """Return MIDI number and name of a note."""
    from .analysis.note_names import midi_to_note, note_to_midi

    try:
        midi = note_to_midi(note) if isinstance(note, str) else note
    except AnalysisError as error:
        raise ParameterError(str(error)) from None
    check_range("note=", midi, LOWEST_NOTE, HIGHEST_NOTE, hint="; 60 is C4")
    whole = float(midi).is_integer()
    return float(midi), midi_to_note(int(midi)) if whole else f"{midi:g}"


def _interpolated(midi: float) -> dict[str, str]:
    """Return the neighbouring published rows by field. Fields that have a row at `midi` are omitted."""
    return {name: place for name, rows in ROWS.items() if (place := _neighbours(midi, rows))}


def _neighbours(midi: float, rows: tuple[PublishedString | PublishedHammer | PublishedLoss, ...]) -> str:
    """Return the rows next to a note as text. It is empty if the note has a row."""
    if any(row.midi == midi for row in rows):
        return ""
    below, above = [row.note for row in rows if row.midi < midi], [row.note for row in rows if row.midi > midi]
    if below and above:
        return f"between {below[-1]} and {above[0]}"
    return f"extrapolated beyond {(below or above[:1])[-1]}"


def _geometry(length: float, mass: float, strike: float | None = None) -> Geometry:
    """Complete a geometry. On the shortest strings the contact window is narrower, to end before the agraffe."""
    width = min(WIDTH, 0.15 * length)
    return Geometry(length, mass, STRIKE * length if strike is None else strike, width, PICKUP * length)


# Published rows that each field of a typical note is interpolated between.
ROWS = {
    **dict.fromkeys(("c", "kappa", "length", "mass", "strike_position", "pickup"), STRINGS),
    **dict.fromkeys(("b1", "b2"), LOSSES),
    **dict.fromkeys(("K_H", "p", "M_H"), HAMMERS),
}
# The interpolated quantities over the MIDI number.
TABLES: dict[str, list[tuple[float, float]]] = {"strings": STRINGS_PER_KEY} | {
    name: [(float(row.midi), getattr(row, name)) for row in rows]
    for names, rows in (("length tension B", STRINGS), ("b1 b2", LOSSES), ("M_H K_H p", HAMMERS))
    for name in names.split()
}


@cache
def _curve(name: str) -> Callable[[float], float]:
    """Return one table as a function of the note number: a monotone cubic between its rows, linear beyond them."""
    midi, values = np.array(TABLES[name]).T
    heights = values if name == "p" else np.log(values)
    within = MonotoneCubic.through(midi, heights)

    def at(x: float) -> float:
        inside = float(np.clip(x, midi[0], midi[-1]))
        beyond = 0.0 if name == "tension" else within.slopes[0 if x < inside else -1] * (x - inside)
        height = float(within(inside) + beyond)
        return height if name == "p" else math.exp(height)

    return at


def _of_the_paper(name: str, string: String, hammer: Hammer, lacks: str = "") -> Preset:
    """A preset with the values that the paper lacks.

    A steel wire of 1 m and 1 mm has 6.18 g, and at c = 310.6 m/s a usual tension of 596 N. Strike and pickup positions
    are those of `typical`. The paper gives no initial κ, so the final one is used.
    """
    geometry = Geometry(length=1.0, mass=6.18e-3, strike_position=0.12, width=0.02, pickup=0.30)
    return Preset(name, None, string, hammer, geometry, PAPER, READ, f"M_S, x0, window, pickup: chosen{lacks}")


def _after_chabassier(row: PublishedString) -> Preset:
    note = _typical(row.midi, row.note)
    return Preset(
        f"chabassier-{row.note.replace('#', 's')}",
        row.note,
        note.string._replace(c=row.c, kappa=row.kappa),
        note.hammer,
        _geometry(row.length, row.mass, row.strike),
        CHABASSIER,
        SECOND_HAND,
        "one string's share of a hammer interpolated from the same source; mu, window, pickup: chosen; losses: "
        "Bensa et al. (2003)",
        _interpolated(row.midi),
    )


def _chaigne_c4() -> Preset:
    length, mass, tension, epsilon = 0.62, 3.93e-3, 670.0, 3.82e-5
    c = math.sqrt(tension * length / mass)
    kappa = math.sqrt(epsilon) * c * length  # the stiffness term of the source is ε c² L² y_xxxx
    note, felt = _typical(60, "C4"), CHAIGNE_HAMMERS[1]
    return Preset(
        "chaigne-askenfelt-C4",
        "C4",
        note.string._replace(c=c, kappa=kappa),
        note.hammer._replace(K_H=felt.K_H, p=felt.p, M_H=felt.M_H),
        _geometry(length, mass),
        CHAIGNE,
        SECOND_HAND,
        "mu, window, pickup: chosen; losses after Bensa et al. (2003), because the source has another loss model",
    )


PRESETS: dict[str, Preset] = {
    entry.name: entry
    for entry in (
        _of_the_paper(
            "bensa-initial",
            String(c=310.6, kappa=1.737, b1=0.500, b2=1.004e-10),
            Hammer(K_H=1.51647e9, mu=0.1000, p=2.55, M_H=6.790e-3, v_H0=0.74078),
            "; kappa: the final value",
        ),
        _of_the_paper(
            "bensa-final",
            String(c=304.101, kappa=1.737, b1=0.568, b2=1.628e-6),
            Hammer(K_H=1.09949e10, mu=0.1998, p=2.56, M_H=5.687e-3, v_H0=0.79993),
        ),
        _chaigne_c4(),
        *map(_after_chabassier, STRINGS),
    )
}
