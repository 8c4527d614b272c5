"""What a fit can claim, said first and plainly."""

from __future__ import annotations

from pathlib import Path

from scipy.special import chdtri

from ..analysis import Analysis
from ..initial import Start
from ..recording import Recording, one_line
from .certainty import Certainty
from .joint import Fit
from .space import NAMES

__all__ = ["verdict", "words"]

FELT = ("K_H", "mu", "p")
# A calibrated recording of the string described is met within hundredths of a decibel. Beyond the first of these, dB,
# something acts that the model does not have (a bridge that moves, a second polarisation, a felt with memory), and the
# felt takes it up; beyond the second it may be another hammer altogether.
STRAINED, POOR = 0.1, 0.5
ONE_TAKE = (
    "One uncalibrated recording does not fix the felt: any hammer's spectrum can be traded for an output path, and a "
    "softer felt struck faster sounds the same through another gain. "
)
NOTHING_COMPARED = (
    "{} uncalibrated takes, but none shares a path with a take of another strike, which does not fix the felt: any "
    "hammer's spectrum can be traded for an output path. "
)
SEVERAL_TAKES = (
    "{} uncalibrated takes of one key: what changes from take to take is the hammer's doing, what they share is the "
    "path's. "
)


def verdict(
    fit: Fit, start: Start, states: dict[str, str], levels: dict, excess: float | None
) -> tuple[str, dict[str, str]]:
    """The opening sentences, and the statuses after what they say.

    Parameters
    ----------
    excess : how much χ² the literature's hammer costs more than the fitted one, both through the best path; None for a
        calibrated recording, which has no path.
    """
    if excess is None and fit.spread.level > STRAINED:
        poor = fit.spread.level > POOR
        text = (
            f"Calibrated recording, but the model misses its levels by {fit.spread.level:.2f} dB beyond the noise: "
            + ("another hammer may explain it better, or the setup is not this string's. The hammer's" if poor else
               "something acts that the model does not have. The felt's")
            + " values are no finding."
        )  # fmt: skip
        doubted = (*FELT, "M_H", "v_H0") if poor else FELT
        return text, states | {n: "not-identifiable" for n in doubted if states[n] == "free"}
    if excess is None:
        lost = [name for name, state in states.items() if state == "not-identifiable" and name != "width"]
        if not lost:
            return "Calibrated recording: all free parameters are identified.", states
        return f"Calibrated recording. Not identifiable from it: {', '.join(lost)}.", states
    hammer, takes = int(fit.space.free[4 : len(NAMES)].sum()), fit.data.layout.takes
    as_good = excess < chdtri(max(hammer, 1), 0.05)
    through = "smooth path" if start.quantity == "pressure" else "gain"
    compared = fit.data.layout.compared
    text = ONE_TAKE if takes == 1 else (SEVERAL_TAKES if compared else NOTHING_COMPARED).format(takes)
    text += (
        f"Partial levels: {levels['initial_db']:.1f} dB off at the start; "
        f"{levels['path_only_db']:.1f} dB with the literature's hammer through the best {through}; "
        f"{levels['fitted_db']:.1f} dB with the fitted hammer through its own. "
    )
    if as_good:
        text += f"The {through} alone is as good: the hammer's values are one possibility, not a finding."
        states = states | {n: "not-identifiable" for n in (*FELT, "M_H") if states[n] in ("free", "at-bound")}
    else:
        text += (
            f"The fitted hammer explains more than a {through} alone; its values still rest on that being all there is."
        )
        if not compared:
            # Through a path that is not known the mass rests on the path's smoothness as much as the felt does.
            doubted = (*FELT, "M_H") if start.quantity == "pressure" else FELT
            states = states | {n: "not-identifiable" for n in doubted if states[n] == "free"}
    if takes > 1 and start.fixed.get("v_H0") == "assumed":
        states = states | {n: "assumed" for n in ("K_H", "mu") if states[n] == "free"}
    if "v_H0" in start.fixed and start.fixed["v_H0"] == "assumed":
        text += f" The hammer velocity{' of the fastest' * (takes > 1)}, {start.values['v_H0']:g} m/s, is assumed, and "
        text += f"{'the other velocities, ' * (takes > 1)}K_H and μ scale with it."
    return text, states


def words(
    fit: Fit,
    start: Start,
    analyses: list[Analysis],
    recordings: list[Recording],
    states: dict[str, str],
    pairs: list[tuple[str, str, float]],
    worse: list[str],
    sure: Certainty,
) -> list[str]:
    """Plain sentences on what to beware of, the weightiest first."""
    said = list(fit.messages)
    if worse:
        said.append(f"No lower on the paper's criterion than at the start: {', '.join(worse)}.")
    bound = [n for n, s in states.items() if s == "at-bound"]
    if bound:
        said.append(f"At the edge of the box, so their values are the box's: {', '.join(bound)}.")
    said += sure.messages
    said += [f"{a} and {b} are not told apart (correlation {r:+.3f})." for a, b, r in pairs]
    if fit.data.calibrated and fit.spread.level > POOR:
        said.append("Try another seed, and check the setup's strike, pickup and scale.")
    if fit.agreeing == 1:
        said.append("Only one of the hammers tried reached the lowest cost; another seed may find a better one.")
    rests = sorted({x for names in start.rests_on.values() for x in names})
    if rests:
        said.append(
            f"The string's {' and '.join(rests)} were not given and are the literature's for this key; "
            f"the SI values of {', '.join(start.rests_on)} rest on them."
        )
    missing = [f"band {b + 1}" for b in range(3) if b not in fit.data.occupied]
    if missing:
        said.append(f"No partial above the noise in {' and '.join(missing)}; dropped, and the next band used.")
    if fit.space.free[NAMES.index("width")]:
        said.append(
            "The shape of the contact's window is not known, so its width is fitted along: an effective "
            f"{1e3 * fit.values[NAMES.index('width')]:.2f} mm (given or assumed: {1e3 * start.geometry.width:.2f} mm)."
        )
    said.append(
        f"Beyond the noise, partials scatter about the model by {fit.spread.frequency:.2f} cents, "
        f"{100 * fit.spread.decay:.0f} % in decay and {fit.spread.level:.2f} dB in level; the intervals include it."
    )
    for recording, analysis in zip(recordings, analyses, strict=True):
        about = f"{one_line(Path(recording.path).name)}: " if len(recordings) > 1 else ""
        said += [about + warning for warning in (*recording.warnings, *analysis.warnings)]
    return said
