"""A fit as text for the page: notices, sentences, rows of tables and formatted numbers.

The recipes of the paper leave some entries of a fit empty. Text is plain; the page escapes it.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import PurePath

from ..felt import LAWS
from ..io.number_format import number, with_interval
from ..schema.dependencies import derived_status
from ..schema.derived import Recontact
from ..schema.fit import LEVEL_RANGE, LEVEL_TOP, Criterion, Fit
from ..schema.quantities import T60, Quantity, Status

STATUS = {  # status -> mark, explanation
    "fitted": ("●", "estimated from the recording"),
    "scaled": ("◐", "estimated, but scales with an assumed value"),
    "given": ("■", "fixed at the given value"),
    "assumed": ("◇", "fixed at an assumed value; other values scale with it"),
    "at-bound": ("▲", "at a search bound, which sets the value"),
    "not-identifiable": ("✕", "the recording does not determine it"),
}
# Name -> symbol, where they differ. Pages and pictures set the part after "_" as an index.
SYMBOLS = {
    "kappa": "κ",
    "mu": "μ",
    "skin": "d",
    "epsilon": "ε",
    "tau": "τ",
    "b1": "b_1",
    "b2": "b_2",
    "x0": "x_0",
    "f0": "f_0",
}
SYMBOLS |= {"x0/L": "x_0/L", "contact_time": "contact time", "peak_force": "peak force", "felt_force": "felt force"}
SYMBOLS |= {"local_exponent": "local exponent"}
SYMBOLS |= {"peak_compression": "peak compression", "felt_loss": "felt loss"}
# Bands of the criterion of Bensa et al. (2005).
BANDS = {"band1": "band 1: fundamental", "band2": "band 2: partials 2 to 8", "band3": "band 3: partials from 9"}
VELOCITY_RATIO = "v/v_ref "
# The partials whose levels are compared (`LEVEL_TOP` and `LEVEL_RANGE`).
COMPARED = f"partials up to {LEVEL_TOP / 1000:g} kHz, within {LEVEL_RANGE:g} dB of the strongest"
# Parameters that do not belong to the felt.
NOT_FELT = {"c", "kappa", "b1", "b2", "M_H", "v_H0", "x0", "width", "M_S", "L", "pickup"}
NOT_CONVERGED = "The search stopped before it converged. Do not use the numbers on this page as results."


# --- tables -----------------------------------------------------------------------------------------------------------


def rows(table: Mapping[str, Quantity]) -> list[dict[str, str]]:
    """Return the table of parameters or invariants as text, one row a quantity."""
    return [_row(quantity) for quantity in table.values()]


def _row(quantity: Quantity) -> dict[str, str]:
    value, interval = with_interval(quantity.value, quantity.interval)
    is_ratio = quantity.name.startswith(VELOCITY_RATIO)
    note = PurePath(quantity.note).name if is_ratio else quantity.note
    return {
        "name": "v/v_ref" if is_ratio else symbol(quantity.name),
        "meaning": quantity.meaning,
        "value": value,
        "unit": format_unit(quantity.unit),
        "interval": interval,
        "initial": number(quantity.initial),
        "status": quantity.status,
        "mark": STATUS[quantity.status][0],
        "note": "; ".join(filter(None, (note, _unbounded(quantity)))),
    }


def symbol(name: str) -> str:
    """Return the symbol of a quantity. The page sets the part after "_" as an index."""
    return f"T_60({name.removeprefix(T60)})" if name.startswith(T60) else SYMBOLS.get(name, name)


def format_unit(unit: str) -> str:
    """Return a unit for the page: empty for a pure number, with a superscript p."""
    return "" if unit == "1" else unit.replace("^p", "ᵖ")


def _unbounded(quantity: Quantity) -> str:
    """Return which ends of the interval come from the range of the parameter and not from the recording."""
    ends = quantity.interval_unbounded
    side = "" if len(ends) == 2 else "lower " if "low" in ends else "upper "
    return f"the recording sets no {side}limit; the interval ends at the bound of the parameter" if ends else ""


def minima(fit: Fit) -> tuple[list[tuple[str, str]], list[tuple[str, str, list[str], str]]] | None:
    """Return the table of the minima; None if there is only one.

    It has symbol and unit of the parameters that differ, and for each minimum its weight, its objective above the
    lowest, the values and the velocities.
    """
    if len(fit.minima) < 2:
        return None
    felt = [name for name in fit.parameters if name not in NOT_FELT]
    names = [
        name
        for name in (*felt, "M_H", "x0", "pickup", "width")
        if len({m.parameters.get(name) for m in fit.minima}) > 1
    ]
    lowest = min(minimum.negative_log_posterior for minimum in fit.minima)
    table = [
        (
            "< 1 %" if minimum.weight < 0.005 else f"{100 * minimum.weight:.0f} %",
            number(minimum.negative_log_posterior - lowest, 2),
            [number(minimum.parameters.get(name), 4) for name in names],
            ", ".join(number(velocity, 3) for velocity in minimum.stroke_values.tolist()),
        )
        for minimum in fit.minima
    ]
    return [(SYMBOLS.get(name, name), format_unit(fit.parameters[name].unit)) for name in names], table


def groups(fit: Fit) -> list[tuple[str, str, str, list[str]]]:
    """List (status, mark, explanation, symbols) of each status that occurs."""
    symbols = {
        status: [SYMBOLS.get(n, n) for n, q in fit.parameters.items() if q.status == status] for status in STATUS
    }
    return [(status, *STATUS[status], names) for status, names in symbols.items() if names]


def bands(criterion: Criterion) -> list[tuple[str, str, str, str]]:
    """Return label, values before and after the fit, and change of the criterion: all bands together, then each."""
    table = []
    for name, label in ({"global": "all bands together"} | BANDS).items():
        if value := criterion.bands.get(name):
            change = _change(value.initial, value.final)
            table.append((label, number(value.initial, 3), number(value.final, 3), change))
        elif name in criterion.excluded_bands:
            table.append((label, "–", "–", "excluded: none of its partials is above the noise"))
    return table


def _change(initial: float, final: float) -> str:
    """Return the change of a criterion (a relative squared error) as a factor and in dB."""
    if not (initial > 0 and final > 0):
        return "–"
    ratio = initial / final
    if abs(ratio - 1) < 5e-4:
        return "no change"
    factor = f"{number(ratio, 3)} times smaller" if ratio > 1 else f"{number(1 / ratio, 3)} times larger"
    return f"{factor} ({-10 * math.log10(ratio):+z.1f} dB)".replace("-", "−")


# --- sentences --------------------------------------------------------------------------------------------------------


def notices(fit: Fit) -> list[tuple[str, str, str]]:
    """List (tone, heading, text) of the notices at the top: the statement, and the problems."""
    all_measured = all(quantity.status in ("fitted", "given") for quantity in fit.parameters.values())
    overall = fit.criterion.bands["global"]
    is_worse = overall.final > overall.initial
    tone, mark = ("good", "✓") if fit.converged and all_measured and not is_worse else ("warn", "⚠")
    notices = [(tone, f"{mark} Read this first", fit.identifiability_statement)]
    if not fit.converged:
        notices.append(("warn", "⚠ Not converged", NOT_CONVERGED))
    if is_worse:
        change = f"from {overall.initial:.3g} to {overall.final:.3g}"
        text = f"The fit increased the criterion of Bensa et al. (2005) {change}."
        if fit.recipe == "default":
            text += (
                " The fit does not minimise this criterion. It fits the levels, frequencies and decay rates of the "
                "partials."
            )
        notices.append(("warn", "⚠ Higher criterion", text))
    return notices


def summary_tiles(fit: Fit) -> list[tuple[str, str, str]]:
    """List (name, number, explanation) of the figures at the top of the page."""
    levels, derived, overall, count = fit.levels, fit.derived, fit.criterion.bands["global"], len(fit.recordings)
    recordings, bend = f" in {count} recordings" if count > 1 else "", glide(fit)
    return [
        (
            "Error of the partials’ levels",
            f"{number(levels.fitted_db, 2)} dB",
            f"{number(levels.initial_db, 2)} dB before the fit; rms over {levels.partials} levels of "
            f"partials{recordings} ({COMPARED})",
        ),
        (
            "Criterion (spectral error)",
            number(overall.final, 3),
            f"{number(overall.initial, 3)} before the fit, {_change(overall.initial, overall.final)}",
        ),
        (
            "Pitch f₀",
            f"{number(derived.f0, 5)} Hz",
            f"inharmonicity B = {number(derived.B, 3)}" + (f"; pitch {bend} as the note decays" if bend else ""),
        ),
        *_contact_tile(fit),
    ]


def _contact_tile(fit: Fit) -> list[tuple[str, str, str]]:
    """Return the tile of the contact. A value that is not identifiable is left out of the headline."""
    table, names = fit.derived.quantities, {"peak_force": "largest force", "peak_compression": "largest compression"}
    if "contact_time" not in table:
        return []
    time, span = with_interval(table["contact_time"].value, table["contact_time"].interval)
    known = table["contact_time"].status != "not-identifiable"
    parts = [f"{span} ms" if known and span else "" if known else f"one possibility is {time} ms"]
    parts += [f"{words}: {_with_status(table[name])}" for name, words in names.items()]
    parts.append(recontact_text(fit.derived.recontacts))
    return [("Hammer contact", f"{time} ms" if known else "not identifiable", "; ".join(filter(None, parts)))]


def _with_status(quantity: Quantity) -> str:
    """Return the value with its unit and interval, or that it is not identifiable."""
    if quantity.status == "not-identifiable":
        return "not identifiable"
    value, span = with_interval(quantity.value, quantity.interval)
    return f"{value} {quantity.unit}" + (f" ({span})" if span else "")


def recontact_text(contacts: Sequence[Recontact]) -> str:
    """Return how often, when and how hard the hammer touches the string after its first contact; empty if never."""
    if not contacts:
        return ""
    start, end = number(contacts[0].start_ms, 3), number(contacts[-1].start_ms + contacts[-1].duration_ms, 3)
    times = f"from {start}" if len(contacts) == 1 else f"{len(contacts)} times, from {start} ms"
    hardest = number(max(contact.max_force_N for contact in contacts), 2)
    return f"touches again {times} to {end} ms, with up to {hardest} N"


def glide(fit: Fit) -> str:
    """Return how the pitch changes while the note decays; empty if it does not."""
    cents = fit.derived.glide_cents
    if f"{abs(cents):.1f}" == "0.0":
        return ""
    return f"{'falls' if cents >= 0 else 'rises'} by {abs(cents):.1f} cents"


def initial_hammer_text(fit: Fit) -> str:
    """Compare the fit with the initial hammer at fitted velocities, gain and path; empty if that was not computed."""
    initial_hammer, fitted = fit.levels.initial_hammer_db, fit.levels.fitted_db
    if initial_hammer is None or fitted is None:
        return ""
    reported = (*fit.parameters.values(), *fit.invariants.values())
    states: dict[str, Status] = {quantity.name: quantity.status for quantity in reported}
    conclusion = "The levels of the partials therefore do not support the fitted hammer over the initial one."
    if derived_status("hammer", states) in ("not-identifiable", "at-bound"):
        conclusion = "The recordings do not determine the hammer, so this is not evidence for the fitted hammer."
    elif initial_hammer > fitted + 0.1:
        conclusion = "The fitted hammer explains more of the levels."
    return (
        "If felt and hammer mass keep their initial values and everything else is fitted, the error of the levels of "
        f"the partials is {initial_hammer:.1f} dB. With the fitted hammer it is {fitted:.1f} dB. {conclusion}"
    )


def interval_method_text(fit: Fit) -> str:
    """Return how the intervals were computed; empty for Laplace's approximation."""
    if fit.diagnostics.profile:
        return (
            "The intervals are profile intervals: each parameter was fixed at values around its estimate, and all "
            "others were fitted again. The band of the felt and the correlations below use Laplace’s approximation."
        )
    if (posterior := fit.diagnostics.posterior) is None:
        return ""
    parameters = posterior.parameters.values()
    rhat = max(entry.rhat for entry in parameters)
    effective_size = min(min(entry.ess_bulk, entry.ess_tail) for entry in parameters)
    return (
        f"The intervals come from samples of the posterior: {posterior.chains} chains of {posterior.draws} "
        f"draws. They are as accurate as at least {effective_size:.0f} independent draws. "
        f"R-hat is at most {rhat:.3f} (1 when the chains agree)."
    )


def is_power_law(fit: Fit) -> bool:
    """Return whether the static force of the felt is K_H u^p; False with a skin and for a user law."""
    law = LAWS.get(fit.felt)
    return law is not None and law.power is not None and law.base is None
