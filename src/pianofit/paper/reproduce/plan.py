"""How much is computed: all of it, or just enough to see that everything works."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ..laboratory import Laboratory
from ..laboratory.chosen import CONTACT_RATE, SECONDS

__all__ = ["EFFECTS", "FULL", "NOISE_DB", "QUICK", "Plan"]

NOISE_DB = 60.0  # the laboratory's own, and left in the ideal one
# What the laboratory has and the paper's model has not, each to be tried alone beside the noise.
EFFECTS: dict[str, dict[str, Any]] = {
    "second polarisation": {"polarisation": True},
    "yielding bridge": {"bridge": True},
    "relaxing felt": {"felt": "memory"},
}


@dataclass(frozen=True)
class Plan:
    """Sizes of the studies. Velocities in m/s."""

    # The paper's Figure 6 is at 0.84 and Figure 7 at 1.1; its authors' page has 0.618, 0.844 and 1.299; its recordings
    # end at 2.3.
    velocities: tuple[float, ...] = (0.618, 0.844, 1.1, 1.299, 2.3)
    origin: float = 0.844  # from which the others are predicted
    waveform: float = 1.1
    heard: tuple[float, ...] = (0.618, 0.844, 1.299)  # in the listening test
    repeats: int = 4
    effects: tuple[str, ...] = tuple(EFFECTS)
    effect_recipes: tuple[str, ...] = ("paper", "read", "default")
    annealing: int | None = None  # evaluations of the paper's recipe; its own number if None
    tries: int = 2  # annealings for a fit, of which the best counts, but for repeated measurements
    # Band 3: points of the landscape along each side, starts, iterations of the gradient, evaluations of an annealing.
    grid: int = 49
    starts: int = 12
    iterations: int = 400
    evaluations: int = 10_000
    noises: int = 5  # measurements that differ in their noise alone, for b2
    losses: int = 36  # values of b2
    seconds: float = SECONDS  # of a measurement
    contact_rate: float = CONTACT_RATE  # Hz

    def laboratory(self) -> Laboratory:
        """The full one."""
        return Laboratory(noise_db=NOISE_DB, seconds=self.seconds, contact_rate=self.contact_rate)

    def ideal(self, **switches: Any) -> Laboratory:
        """The paper's own model and noise, but for `switches`."""
        return Laboratory.ideal(noise_db=NOISE_DB, seconds=self.seconds, contact_rate=self.contact_rate, **switches)


FULL = Plan()
QUICK = Plan(
    velocities=(0.844, 1.1), heard=(0.844,), repeats=2, effects=("relaxing felt",), effect_recipes=("paper", "read"),
    grid=13, starts=2, iterations=10, evaluations=640, noises=2, losses=8, annealing=500, tries=1, seconds=1.0,
    contact_rate=2e5,
)  # fmt: skip
