"""The left pedal of a grand piano: the hammer is moved so that it strikes one string less.

Right after a stroke the struck strings move the bridge together. With one of n strings unstruck, this prompt sound
falls to (n - 1)/n, for the same force on each struck string. The aftersound, in which strings move against each other,
does not fall (Weinreich, J. Acoust. Soc. Am. 62, 1474, 1977). The whole hammer meets n - 1 strings, so that mass and
felt force of one string's share rise by n/(n - 1). So the prompt sound hardly changes, and the aftersound rises over
it. The felt between the grooves of the strings is softer, by `FELT_RATIO`. Keys with one string change by the felt
alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from ..felt import RelaxingHammer, SoftHammer
from ..literature import typical_strings
from ..model.modal_response import ModalResponse
from ..parameters import Hammer

AnyHammer = TypeVar("AnyHammer", bound=Hammer | SoftHammer | RelaxingHammer)
# Stiffness of the felt between the grooves over that in them. Chosen: no published value was found.
FELT_RATIO = 0.7


@dataclass(frozen=True)
class UnaCorda:
    """Effect of the left pedal on a key.

    Parameters
    ----------
    share : prompt sound over that without the pedal, for the same force on one string.
    load : mass and felt force of one string's share over those without the pedal.
    felt : stiffness of the felt over that without the pedal.
    """

    share: float = 1.0
    load: float = 1.0
    felt: float = 1.0

    def hammer(self, hammer: AnyHammer) -> AnyHammer:
        """Return the hammer as the pedal moves it."""
        return hammer._replace(M_H=self.load * hammer.M_H, K_H=self.load * self.felt * hammer.K_H)

    def weights(self, response: ModalResponse) -> np.ndarray:
        """Amplitudes of modes over those without the pedal [modes], or [1] without it.

        They are `share` for prompt modes, and 1 for others.

        A mode is prompt if it decays at least as fast as the geometric mean of the fastest and the slowest of its
        partial.
        """
        if self.share == 1.0:
            return np.ones(1)
        weight = np.ones(len(response.pole))
        rate = -np.real(response.pole)
        _, partial = np.unique(response.partial, return_inverse=True)
        fastest, slowest = np.zeros(partial.max() + 1), np.full(partial.max() + 1, np.inf)
        np.maximum.at(fastest, partial, rate)
        np.minimum.at(slowest, partial, rate)
        weight[rate >= np.sqrt(fastest * slowest)[partial] * (1 - 1e-12)] = self.share
        return weight

    def response(self, response: ModalResponse, weight: np.ndarray) -> ModalResponse:
        """Return the response with its modes weighted, and the knock as the prompt sound."""
        if self.share == 1.0:
            return response
        return response._replace(pattern=weight * response.pattern, knock=self.share * response.knock)


def una_corda(midi: int, position: float) -> UnaCorda:
    """Return the effect of the left pedal at a position from 0 (up) to 1 (down)."""
    if not position:
        return UnaCorda()
    strings = max(round(typical_strings(midi)), 1)
    struck = strings - position if strings > 1 else 1.0
    return UnaCorda(struck / strings, strings / struck, FELT_RATIO**position)
