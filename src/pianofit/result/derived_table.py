"""The derived quantities that every fit reports."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ..schema.fit import Fit
from ..schema.quantities import T60, Quantities, Quantity, meaning_of
from .derived import DrawSet, ModelDraw
from .posterior import ENDS
from .result import Result

# Those that hold at the reference compression.
AT_REFERENCE = ("felt_force", "local_exponent")


def with_derived(result: Result) -> Result:
    """Return a result with its derived quantities, and with the intervals of a sampler for its invariants."""
    fit = result.fit
    derived = replace(fit.derived, quantities=derived_quantities(result.draw_set))
    return replace(result, fit=replace(fit, derived=derived, invariants=_with_sampled_intervals(result)))


def derived_quantities(draws: DrawSet) -> Quantities:
    """Return the derived quantities of a fit with intervals and statuses.

    With a hammer they are contact time, largest force and compression of the reference stroke, the felt force at the
    reference compression and its exponent there, and the energy lost in the felt. All fits have T60 of the partials 1,
    2, 4 and so on up to the highest detected one.
    """
    fit = draws.fit
    u, method = fit.derived.reference_compression_mm, "laplace" if draws.sampled is None else "posterior"
    table = _of_contact(u) if draws.law.has_contact else {}
    last = int(fit.reference.partials.number.max())
    octaves = [2**i for i in range(last.bit_length())]  # the law is smooth in between
    table |= {f"{T60}{k}": ("s", lambda draw, k=k: draw.t60(k)) for k in octaves}

    def quantity(name: str, unit: str, function: Callable[[ModelDraw], float]) -> Quantity:
        found = draws.evaluate(function)
        if name == "felt_force" and method == "laplace":
            found = replace(found, interval=_of_ratio(fit, found.interval))
        note = "; ".join(filter(None, (f"at {u:.3g} mm" * (name in AT_REFERENCE), found.note)))
        own = None if found.interval is None else method
        return Quantity(name, found.value, unit, found.interval, found.status, meaning_of(name), note, None, own)

    return Quantities.of(quantity(name, *entry) for name, entry in table.items())


def _of_contact(u: float) -> dict[str, tuple[str, Callable[[ModelDraw], float]]]:
    """Return unit and function of each quantity of a hammer's contact, with the felt at the compression `u`, mm."""
    return {
        "contact_time": ("ms", lambda draw: 1e3 * draw.stroke.contact_time),
        "peak_force": ("N", lambda draw: float(draw.stroke.pulse.force.max())),
        "peak_compression": ("mm", lambda draw: 1e3 * float(draw.stroke.pulse.compression.max())),
        "felt_loss": ("1", lambda draw: draw.felt_loss),
        "felt_force": ("N", lambda draw: draw.felt_force(1e-3 * u)),
        "local_exponent": ("1", lambda draw: draw.local_exponent(1e-3 * u)),
    }


def _of_ratio(fit: Fit, drawn: tuple[float, float] | None) -> tuple[float, float] | None:
    """Return the interval of the felt force from that of F/M_S, by which its status is decided.

    It is that of the draws if the string mass is uncertain, and without F/M_S.
    """
    ratio, mass = fit.invariants.get("F/M_S"), fit.parameters["M_S"]
    if drawn is None or ratio is None or ratio.interval is None or mass.interval is not None:
        return drawn
    low, high = ratio.interval
    return float(low * mass.value), float(high * mass.value)


def _with_sampled_intervals(result: Result) -> Quantities:
    """Return the invariants, with the interval of a sampler's draws for those that vary in them."""
    draws = result.draws or {}

    def sampled(name: str, own: Quantity) -> Quantity:
        if name not in draws or own.interval_method == "posterior":
            return own
        low, high = np.quantile(draws[name], ENDS).tolist()
        return replace(own, interval=(low, high), interval_method="posterior")

    return Quantities({name: sampled(name, own) for name, own in result.fit.invariants.items()})
