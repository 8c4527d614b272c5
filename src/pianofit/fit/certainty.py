"""How sure a fit is, by one of three means: the curvature at the estimate, profiles of the cost, or the posterior.

All three say the same where the cost is a parabola, for all are given the sandwich's variances and Student's quantile.
Where it is not, the curvature sees the bottom of the valley only; a profile follows it, one parameter at a time; the
posterior is all of it. An end that is `open` is an edge of the box, not of what the recording allows; beyond any other
end lie 2.5 %.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.special import stdtrit

from ..errors import ParameterError
from ..parameters import STRING_NAMES
from .joint import Fit
from .posterior import Draws, check_sampler, draw
from .profile import Profile, profiles
from .recipe import Progress
from .space import LOG, NAMES
from .state import level_freedom
from .surface import Surface, surface_of
from .uncertainty import intervals

__all__ = ["MEANS", "Certainty", "assess", "check_intervals"]

MEANS = ("curvature", "profile", "posterior")
NORMAL = 1.959964
# The chains have not mixed above this, and tell too little below this many independent draws (Vehtari et al. 2021).
MOST_RHAT, LEAST_ESS = 1.01, 400
# Next to an edge the posterior's density is no less than this share of its highest: the ends of a normal's interval.
CUT = float(np.exp(-0.5 * NORMAL**2))
# A cost this far below the estimate's is another estimate.
LOWER = 0.1

Span = tuple[float, float]


@dataclass(frozen=True)
class Certainty:
    """What is known of a fit's parameters, and by what means."""

    covariance: np.ndarray  # of search coordinates [size, size], log K_H in the force's place; 0 for what is fixed
    spans: dict[str, Span | None]  # 95 %, by name
    by: dict[str, str | None]
    reach: np.ndarray  # standard deviations to the end of an interval [size]: Student's quantile
    open: dict[str, tuple[str, ...]] = field(default_factory=dict)  # `low`, `high`
    diagnostics: dict = field(default_factory=dict)
    messages: tuple[str, ...] = ()
    draws: dict[str, np.ndarray] | None = None  # values [chains, draws], by name

    @property
    def cov(self) -> np.ndarray:
        """Of log(parameter) [names, names]."""
        return self.covariance[:LOG, :LOG]

    @property
    def variances(self) -> np.ndarray:
        """Of log(parameter), on the diagonal [names, names]: what the intervals mean, however they were found."""
        reach = np.sqrt(np.diag(self.cov))
        for i, name in enumerate(NAMES):
            if span := self.spans[name]:
                reach[i] = np.log(span[1] / span[0]) / (2 * NORMAL)
        return np.diag(reach**2)


def check_intervals(means: str, recipe: str = "default") -> None:
    """Refuse a means that does not exist, a recipe that has none, and a sampler that is not installed.

    Raises
    ------
    ParameterError
        Naming the argument and its value.
    """
    if means not in MEANS:
        raise ParameterError(f"intervals={means!r} must be one of {', '.join(MEANS)}")
    if means != MEANS[0] and recipe != "default":
        raise ParameterError(f"intervals={means!r} are those of the default recipe; recipe={recipe!r} gives none")
    if means == "posterior":
        check_sampler()


def assess(fit: Fit, means: str = "curvature", seed: int = 0, progress: Progress = lambda *_: None) -> Certainty:
    """Intervals of a settled fit by the `means` asked for; `seed` is the sampler's."""
    surface = surface_of(fit)
    freedom = freedoms(fit)
    found = by_curvature(surface, freedom)
    if means == "profile":
        progress("profiles", 0.9)
        found = by_profile(surface, found)
    elif means == "posterior":
        progress("posterior", 0.9)
        found = by_posterior(surface, found, draw(surface, seed))
    return found


def freedoms(fit: Fit) -> np.ndarray:
    """Degrees of freedom that are left [size]: levels alone tell of hammer, gains and paths, everything of the string.

    With few levels the scatter that is read off them is itself not well known: that is what Student's quantile is for.
    """
    size = len(fit.space.free)
    whole = 3 * int(fit.data.found.sum()) - int(fit.space.free.sum())
    by_levels = (np.arange(size) >= len(STRING_NAMES)) & ~np.isin(np.arange(size), fit.data.layout.cents)
    return np.maximum(np.where(by_levels, min(level_freedom(fit.state), whole), whole), 1)


def by_curvature(surface: Surface, freedom: np.ndarray | int) -> Certainty:
    """Symmetric in the logarithm; nothing for what is pressed against a bound."""
    change = np.stack([surface.direction(i) for i in range(len(surface.z))])
    cov = change @ surface.covariances()[1] @ change.T
    freedom = np.broadcast_to(freedom, len(cov))
    spans = intervals(cov[:LOG, :LOG], surface.values[:LOG], freedom[:LOG])
    by = {name: "curvature" if span else None for name, span in spans.items()}
    return Certainty(cov, spans, by, stdtrit(freedom, 0.975))


def by_profile(surface: Surface, curvature: Certainty) -> Certainty:
    """Of every fitted parameter; of those at a bound too. The covariance stays the curvature's."""
    which = np.flatnonzero(surface.space.free[:LOG]).tolist()
    found = profiles(surface, which, curvature.reach)
    told = {
        name: {"allowed_rise": p.allowed, "evaluations": p.evaluations, "points": [list(point) for point in p.points]}
        for name, p in found.items()
    }
    return Certainty(
        curvature.covariance,
        curvature.spans | {name: _in_box(surface, name, p.interval) for name, p in found.items()},
        curvature.by | dict.fromkeys(found, "profile"),
        curvature.reach,
        {name: p.open for name, p in found.items()},
        {"profile": told},
        (*_profile_words(found), *_open_words({name: p.open for name, p in found.items()})),
    )


def by_posterior(surface: Surface, curvature: Certainty, draws: Draws) -> Certainty:
    """Quantiles of the draws.

    The sampler knows the weights, not how the residuals vary, and takes their scale as known: distances from the
    estimate are stretched by the sandwich's standard deviation over the curvature's, and by Student's quantile over the
    normal's.
    """
    which = np.flatnonzero(surface.space.free).tolist()
    wider = np.ones(len(surface.z))
    wider[which] = [np.sqrt(surface.inflation(i)) for i in which]
    whole = np.cov(draws.z.reshape(-1, draws.z.shape[-1]).T) * np.outer(wider, wider)
    logs = np.append(np.log(surface.values[:LOG]), surface.z[LOG:])
    z = logs + (draws.z - logs) * wider * curvature.reach / NORMAL
    names = [i for i in which if i < LOG]
    ends = {NAMES[i]: _ends(surface, i, z[..., i]) for i in names}
    told = {
        name: {"rhat": float(draws.rhat[i]), "ess_bulk": float(draws.bulk[i]), "ess_tail": float(draws.tail[i]),
               "median": float(np.exp(np.median(z[..., i])))}
        for i, name in enumerate(NAMES) if i in names
    }  # fmt: skip
    chains, count = z.shape[:2]
    return Certainty(
        whole * np.outer(surface.space.free, surface.space.free),
        curvature.spans | {name: span for name, (span, _) in ends.items()},
        curvature.by | dict.fromkeys(ends, "posterior"),
        curvature.reach,
        {name: unbounded for name, (_, unbounded) in ends.items()},
        {"posterior": {
            "sampler": _sampler(), "chains": chains, "draws": count, "acceptance": draws.acceptance,
            "divergences": draws.divergences, "evaluations": draws.evaluations, "parameters": told,
        }},
        (*_posterior_words(draws, which), *_open_words({name: unbounded for name, (_, unbounded) in ends.items()})),
        {NAMES[i]: np.exp(z[..., i]) for i in names},
    )  # fmt: skip


def _sampler() -> str:
    from importlib.metadata import version

    return f"NUTS, blackjax {version('blackjax')}"


def _in_box(surface: Surface, name: str, span: Span) -> Span:
    i = NAMES.index(name)
    low, high = np.clip(span, surface.space.lower[i], surface.space.upper[i])
    return float(low), float(high)


def _ends(surface: Surface, i: int, log: np.ndarray) -> tuple[Span, tuple[str, ...]]:
    """The interval of one parameter from its draws, and its open ends: those at which the box cuts the density off."""
    low, high = np.quantile(log, [0.025, 0.975])
    edges = np.log(surface.space.lower[i]), np.log(surface.space.upper[i])
    # As many bins as leave each enough draws.
    bins = np.histogram(log, bins=20, range=(low, high))[0]
    width = (high - low) / len(bins)
    unbounded = []
    for inward, word in ((log - edges[0], "low"), (edges[1] - log, "high")):
        if (inward <= width).sum() > CUT * bins.max():
            unbounded.append(word)
    span = (edges[0] if "low" in unbounded else low), (edges[1] if "high" in unbounded else high)
    return _in_box(surface, NAMES[i], (float(np.exp(span[0])), float(np.exp(span[1])))), tuple(unbounded)


def _open_words(ends: dict[str, tuple[str, ...]]) -> list[str]:
    both = [name for name, sides in ends.items() if len(sides) == 2]
    said = [f"Not bounded by this recording, so its interval is the whole box: {', '.join(both)}."] if both else []
    for word, which in (("low", "below"), ("high", "above")):
        one = [name for name, sides in ends.items() if sides == (word,)]
        said += [f"Not bounded {which} by this recording, so the interval ends at the box: {', '.join(one)}."] * bool(
            one
        )
    return said


def _profile_words(found: dict[str, Profile]) -> list[str]:
    lower = [name for name, p in found.items() if p.lowest < -LOWER]
    unsettled = [name for name, p in found.items() if not p.settled]
    said = []
    if lower:
        by = -min(p.lowest for p in found.values())
        said.append(
            f"The profile of {', '.join(lower)} found a cost lower by {by:.2g} than the fit: it had not reached the "
            "least, and another seed may."
        )
    if unsettled:
        said.append(f"Fits along the profile of {', '.join(unsettled)} did not all settle; the ends may be too near.")
    return said


def _posterior_words(draws: Draws, which: list[int]) -> list[str]:
    said, rhat = [], float(draws.rhat[which].max())
    ess = float(min(draws.bulk[which].min(), draws.tail[which].min()))
    if not rhat <= MOST_RHAT:
        said.append(f"The chains have not mixed (R-hat {rhat:.3f}): the posterior's intervals are not to be trusted.")
    if not ess >= LEAST_ESS:
        said.append(f"Only {ess:.0f} independent draws of the posterior: the ends of its intervals are rough.")
    if draws.divergences:
        said.append(f"{draws.divergences} of the sampler's steps diverged: some of the posterior may be missing.")
    return said
