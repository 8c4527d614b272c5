"""Diagnostics of a search, of profiles and of posterior draws, as a `fit.json` has them."""

from dataclasses import dataclass

from .decode import Number


@dataclass(frozen=True)
class ExcessSd:
    """Excess standard deviations beyond the noise."""

    frequency_cents: Number  # at `REFERENCE_PARTIAL`
    decay_relative: Number
    level_db: Number


@dataclass(frozen=True)
class PathPrior:
    """Prior of the smooth output path."""

    smooth_db: Number
    octaves: Number


@dataclass(frozen=True)
class Correlation:
    """Two parameters whose logarithms are strongly correlated."""

    pair: tuple[str, str]
    correlation: Number


@dataclass(frozen=True)
class ProfileCurve:
    """A profile of the objective."""

    points: tuple[tuple[Number, Number], ...]  # value, and rise of the objective
    evaluations: int


@dataclass(frozen=True)
class ParameterConvergence:
    """Convergence of the draws of one parameter (Vehtari et al. 2021)."""

    rhat: Number
    ess_bulk: Number
    ess_tail: Number
    median: Number


@dataclass(frozen=True)
class PosteriorDiagnostics:
    """Diagnostics of posterior sampling."""

    sampler: str
    chains: int
    draws: int
    acceptance: Number
    divergences: int
    evaluations: int
    parameters: dict[str, ParameterConvergence]


@dataclass(frozen=True)
class Diagnostics:
    """Diagnostics of a search. The paper's methods have only the first two."""

    evaluations: int
    partials: int  # levels that were used
    correlated: tuple[Correlation, ...] = ()
    negative_log_posterior: Number | None = None  # at the best minimum
    censored: int | None = None  # bounds of absent partials that were used
    contact_rate_Hz: Number | None = None
    modes: int | None = None
    steps: int | None = None  # of a contact
    excess_sd: ExcessSd | None = None
    path: PathPrior | None = None
    interference_ratio: Number | None = None
    velocity_discrepancy_db: Number | None = None  # ρ, over an e-fold of velocity; None with one stroke
    profile: dict[str, ProfileCurve] | None = None
    posterior: PosteriorDiagnostics | None = None
