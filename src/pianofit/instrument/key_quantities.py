"""Quantities of a key that a recording determines. Each has a law over the keyboard.

Lengths and masses are mostly assumed, and recordings determine only some combinations of parameters (invariants). The
laws use those, so that an assumption does not appear as a difference between keys.
"""

import math
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from ..conversions import HALF_WIDTH_95, hertz_of, midi_of
from ..dsp.loudness import k_weighted_mean_square
from ..excitation import Excitation
from ..felt import ALL_PARAMETERS, FeltLaw, SoftHammer, law_of
from ..felt.soft_skin import SOFT_SKIN
from ..literature import reference_compression, typical
from ..model.note import Note
from ..parameters import HAMMER_NAMES, PARAMETERS, Geometry, String
from .quantity_law import Prior


@dataclass(frozen=True)
class LawQuantity:
    """One quantity over the keyboard. Standard deviations are those of its logarithm, or of cents."""

    title: str
    unit: str
    prior: Prior  # of an instrument from the literature. Chosen once, after the spreads of initial values.
    default_sd: float = 0.1  # of a value without an interval; small for given values
    scale: Literal["linear", "log"] = "log"  # on which the law is smooth

    def scaled(self, values: Any) -> np.ndarray:
        """Return values on the scale of the law."""
        return np.asarray(values) if self.scale == "linear" else np.log(values)

    def unscaled(self, values: Any) -> Any:
        """Return values from the scale of the law."""
        return values if self.scale == "linear" else np.exp(values)

    def interval(self, mean: Any, sd: Any) -> tuple[Any, Any]:
        """Return the ends of a 95 % interval, from mean and standard deviation on the scale of the law."""
        return self.unscaled(mean - HALF_WIDTH_95 * sd), self.unscaled(mean + HALF_WIDTH_95 * sd)


LAW_QUANTITIES = {
    "cents": LawQuantity("tuning: f₀ relative to equal temperament", "cents", Prior(20.0, 15.0, 10.0), 3.0, "linear"),
    "B": LawQuantity("inharmonicity B", "1", Prior(0.7, 0.5, 0.5)),
    "b1": LawQuantity("loss parameter b₁, the same for all partials", "1/s", Prior(0.7, 0.5, 0.6)),
    "d2": LawQuantity("loss d₂ = b₂π²/L², growing with k²", "1/s", Prior(1.0, 0.7, 0.8)),
    "M_H/M_S": LawQuantity("hammer mass over string mass M_H/M_S", "1", Prior(0.6, 0.4, 0.5)),
    "F/M_S": LawQuantity("felt force over string mass where strokes press", "N/kg", Prior(1.5, 1.0, 1.0)),
    "local_exponent": LawQuantity("exponent of the felt force where strokes press", "1", Prior(0.2, 0.1, 0.15)),
    "mu": LawQuantity("felt loss coefficient μ", "s/m", Prior(1.2, 0.5, 0.8)),
    "skin": LawQuantity("thickness of the felt's soft skin", "m", Prior(1.5, 0.7, 1.0)),
    "x0/L": LawQuantity("strike position x₀/L", "1", Prior(0.2, 0.2, 0.2), 1e-2),
    "width/L": LawQuantity("width of the contact window over L", "1", Prior(0.3, 0.3, 0.3), 0.3),
    "L": LawQuantity("string length L", "m", Prior(0.3, 0.3, 0.2), 1e-3),
    "M_S/L": LawQuantity("string mass per metre M_S/L", "kg/m", Prior(0.5, 0.3, 0.3), 1e-3),
    "pickup/L": LawQuantity("pickup position x_m/L", "1", Prior(0.5, 0.3, 0.2), 1e-3),
    "level": LawQuantity("level of a strong stroke", "dB", Prior(60.0, 6.0, 4.0, 1.5), 0.3, "linear"),
}

# Size of the strokes whose level has a law: a fortissimo of 4 m/s. An instrument sets the loudest recordings of
# uncalibrated keys to it, before the keyboard determines them. The loudest pluck of every key has a force of 4 N.
# Recordings do not determine its force, and this one gives plucks and hammers one velocity curve. Players use a few
# newtons.
LOUDEST_VELOCITY = 4.0
# Compression at which the laws state force and exponent, over the reference compression of the key. A stroke at 4 m/s
# reaches 2 to 5 times that. With a skin, force and exponent at the reference compression itself depend on the skin.
PRESSED = 4.0
# Duration and rate of the sound that the level describes, s and Hz.
LEVEL_SECONDS, LEVEL_RATE = 1.0, 44_100


def law_compression(midi: float) -> float:
    """Return the compression, m, at which the laws state felt force and exponent."""
    return PRESSED * reference_compression(midi)


def skin_share(u: float, skin: float) -> float:
    """Return s/(u + s), by which a skin s raises the exponent of the force at the compression u: p (1 + s/(u + s))."""
    return skin / (u + skin)


def law_quantities(law: Excitation) -> dict[str, LawQuantity]:
    """Return the quantities that have laws over the keys of an instrument with this excitation."""
    foreign = {*FeltLaw.key_quantities} - {*law.key_quantities}
    own = {name: quantity for name, quantity in LAW_QUANTITIES.items() if name not in foreign}
    titles = {"level": f"level of a stroke of {LOUDEST_VELOCITY:g} {law.hammer_parameters[law.size].unit}"}
    if law.stroke.name == "x0":
        titles["x0/L"] = f"{law.words.stroke} x₀/L"
    return {name: replace(x, title=titles.get(name, x.title)) for name, x in own.items()}


def stroke_level(note: Note, size: float = LOUDEST_VELOCITY) -> float:
    """Return the K-weighted level of the first second of a stroke (ITU-R BS.1770), dB re full scale.

    `size` is the velocity of a hammer, m/s, or the force of a pluck, N.
    """
    sound = note.with_size(size).render(seconds=LEVEL_SECONDS, rate=LEVEL_RATE, mono=False)
    return 10 * math.log10(max(k_weighted_mean_square(sound, LEVEL_RATE), 1e-30))


def soft_hammer(hammer: Any) -> SoftHammer:
    """Return a hammer with a skin. The law is in log d, so a felt without a skin gets the smallest allowed one."""
    return (
        hammer
        if isinstance(hammer, SoftHammer)
        else SoftHammer(*hammer[: len(HAMMER_NAMES)], skin=ALL_PARAMETERS["skin"].lower)
    )


def key_quantities(note: Note, midi: int) -> dict[str, float]:
    """Return the `LAW_QUANTITIES` of a note.

    They are the deviation of f0 from equal temperament (cents), B, b1 and d2 = b2 π²/L² (decay rate b1 + d2 k², 1/s),
    ratios to string mass and length, felt force over string mass (N/kg) and local exponent at the `law_compression`,
    and μ (s/m). The level is left out: `stroke_level` renders it. A pluck has no quantities of a hammer.
    """
    s, g = note.string, note.geometry
    table = {
        "cents": 100 * (midi_of(note.f0) - midi),
        "B": note.B,
        "b1": s.b1,
        "d2": s.b2 * (math.pi / g.length) ** 2,
        "x0/L": g.strike_position / g.length,
        "width/L": g.width / g.length,
        "L": g.length,
        "M_S/L": g.mass / g.length,
        "pickup/L": g.pickup / g.length,
    }
    return (table | _hammer_quantities(note, midi)) if law_of(note.hammer).key_quantities else table


def _hammer_quantities(note: Note, midi: int) -> dict[str, float]:
    h, u = soft_hammer(note.hammer), law_compression(midi)
    return {
        "M_H/M_S": h.M_H / note.geometry.mass,
        "F/M_S": SOFT_SKIN.force(u, 0.0, h) / note.geometry.mass,
        "local_exponent": h.p * (1 + skin_share(u, h.skin)),
        "mu": h.mu,
        "skin": h.skin,
    }


def at_scale(quantities: np.ndarray, midi: int, scale: Any) -> np.ndarray:
    """Return the `LAW_QUANTITIES` of a struck key if all velocities are multiplied by `scale`.

    The sound stays the same. Quantities are on the scales of their laws. The level is that of the same stroke.
    """
    at, u = dict(zip(LAW_QUANTITIES, quantities, strict=True)), law_compression(midi)
    skin = np.exp(at["skin"])
    p = np.exp(at["local_exponent"]) / (1 + skin_share(u, skin))
    # F = K scale^(1-p) (u²/(u + scale skin))^p
    at["F/M_S"] = at["F/M_S"] + (1 - p) * np.log(scale) + p * np.log((u + skin) / (u + scale * skin))
    at["local_exponent"] = np.log(p * (1 + skin_share(u, scale * skin)))
    at["mu"], at["skin"] = at["mu"] - np.log(scale), at["skin"] + np.log(scale)
    return np.array([*at.values()])


def note_from_quantities(at: dict[str, float], midi: int, quantity: str, law: Excitation) -> Note:
    """Return the note with these `law_quantities`, clipped to their ranges, with a strong stroke and a gain of 1."""
    hertz = hertz_of(midi + at["cents"] / 100)
    # No sound depends on the length, and a string of the law's length may be too fast for the range of c.
    low, high = (speed / (2 * hertz) for speed in (PARAMETERS["c"].lower, PARAMETERS["c"].upper))
    length = float(np.clip(at["L"], low, high))
    mass, c = at["M_S/L"] * length, 2 * length * hertz
    string = {
        "c": c,
        "kappa": c * length * math.sqrt(at["B"]) / math.pi,
        "b1": at["b1"],
        "b2": at["d2"] * (length / math.pi) ** 2,
    }
    hammer = _hammer(at, midi, mass) if law.key_quantities else law.make_hammer({law.size: LOUDEST_VELOCITY})
    geometry = Geometry(length, mass, at["x0/L"] * length, at["width/L"] * length, at["pickup/L"] * length)
    return Note(String(**within_ranges(string)), hammer, geometry.with_window_on_string(), quantity, 1.0)


def _hammer(at: dict[str, float], midi: int, mass: float) -> SoftHammer:
    u = law_compression(midi)
    p = at["local_exponent"] / (1 + skin_share(u, at["skin"]))
    values = {
        "K_H": at["F/M_S"] * mass * math.exp(-SOFT_SKIN.log_power(u, at | {"p": p})),
        "skin": at["skin"],
        "mu": at["mu"],
        "p": p,
        "M_H": at["M_H/M_S"] * mass,
        "v_H0": LOUDEST_VELOCITY,
    }
    return SoftHammer(**within_ranges(values))


def within_ranges(values: dict[str, float]) -> dict[str, float]:
    """Return parameters clipped to their ranges."""
    return {n: float(np.clip(x, ALL_PARAMETERS[n].lower, ALL_PARAMETERS[n].upper)) for n, x in values.items()}


def literature(midi: int) -> dict[str, float]:
    """Return the `LAW_QUANTITIES` of the literature's key, without the level."""
    return key_quantities(literature_note(midi), midi)


def literature_note(midi: int) -> Note:
    """Return the literature's key, with the contact of a fit that is not given the width of the contact."""
    it = typical(midi)
    geometry = it.geometry._replace(width=SOFT_SKIN.typical(it.geometry, None).width)
    hammer = SoftHammer(*it.hammer, SOFT_SKIN.parameters["skin"].prior_median(midi))
    return Note(it.string, hammer, geometry, "bridge-force", 1.0)
