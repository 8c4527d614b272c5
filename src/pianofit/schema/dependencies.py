"""Which reported quantities stand on which: the one table from which statuses follow.

A parameter whose interval is wide needs no rule: the joint posterior carries its width into the interval of everything
that is computed from it. A kind of measurement can also leave a part of the model without any evidence. Then intervals
do not hold, however narrow they are, and neither do those of the quantities that stand on that part. `STANDS_ON` lists
these parts and quantities. A quantity is identified only if everything that it stands on is.
"""

from collections.abc import Iterator, Mapping, Sequence

from .quantities import Status

# Parts of the model that a kind of measurement can leave undetermined:
FELT = "felt"  # the felt's force over compression,
CONTACT = "contact"  # the force over time of a stroke, up to a factor,
VELOCITIES = "velocities"  # and the velocities of the strokes.

STANDS_ON: dict[str, tuple[str, ...]] = {
    # Parameters. Those of a felt law stand on the felt; all others, on frequencies, decays and nodes alone.
    "M_H": (CONTACT,),
    "v_H0": (VELOCITIES,),
    # Invariants. Ratios of velocities have the names of two strokes; each stands on both.
    "f0": ("c",),
    "B": ("c", "kappa"),
    "M_H/M_S": ("M_H",),
    "x0/L": ("x0",),
    "pickup/L": ("pickup",),
    "width/L": ("width",),
    "F/M_S": (FELT,),
    "v/v_ref": ("v_H0",),
    # The comparison of the fitted hammer with the initial one.
    "hammer": ("F/M_S", "M_H"),
}
# Quantities that do not change with an assumed length or mass, or with the common scale of the velocities.
INVARIANT = {"f0", "B", "M_H/M_S", "x0/L", "pickup/L", "width/L", "v/v_ref", "hammer"}
# A quantity whose standard deviation of log(value) exceeds this, a factor of two, is not identifiable.
MAX_LOG_SD = 0.7


def foundations(name: str) -> Iterator[str]:
    """Yield everything that a quantity stands on, directly or not."""
    for below in STANDS_ON.get(name.partition(" ")[0], ()):
        yield below
        yield from foundations(below)


def derived_status(name: str, states: Mapping[str, Status], log_sd: float = 0.0) -> Status:
    """Return the status of a quantity that is computed from others.

    Parameters
    ----------
    name : a name in `STANDS_ON`.
    states : statuses of parameters and invariants by name. A name that is missing was not reported, so nothing rests
        on it.
    log_sd : standard deviation of the logarithm of the quantity by the joint posterior; 0 if it is not known.
    """
    below: list[Status] = [states[other] for other in foundations(name) if other in states]
    status = combined_status(below, log_sd)
    is_scaled = name.partition(" ")[0] not in INVARIANT and {"scaled", "assumed"} & {*below}
    return "scaled" if status == "fitted" and is_scaled else status


def combined_status(below: Sequence[Status], log_sd: float) -> Status:
    """Return the status of a quantity from those of all that it stands on and its own width.

    Parameters
    ----------
    log_sd : standard deviation of the logarithm of the quantity; 0 if it is not known or nothing was fitted.
    """
    for state in ("not-identifiable", "at-bound"):
        if state in below:
            return state
    if log_sd > MAX_LOG_SD:
        return "not-identifiable"
    if not log_sd and all(state in ("given", "assumed") for state in below):
        return "assumed" if "assumed" in below else "given"
    return "fitted"
