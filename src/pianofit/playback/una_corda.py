"""The left pedal of a grand piano: the hammer is moved so that it strikes one string less.

Right after a stroke the struck strings move the bridge together. With one of n strings unstruck, this prompt sound
falls to (n - 1)/n. The aftersound, in which strings move against each other, stays (Weinreich, J. Acoust. Soc. Am. 62,
1474, 1977). The felt between the grooves of the strings is softer, by `FELT_RATIO`. Keys with one string change by the
felt alone. The force on a struck string is taken to be that without the pedal, apart from the felt.
"""

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
# Largest amplitude of an aftersound over that of the whole partial at its begin. Measured ones lie some 20 dB below the
# prompt sound (Weinreich, Scientific American 240, 1979). Chosen: 6 dB.
LARGEST_AFTERSOUND = 0.5


@dataclass(frozen=True)
class UnaCorda:
    """Effect of the left pedal on a key.

    Parameters
    ----------
    share : prompt sound over that without the pedal, for the same force on one string.
    felt : stiffness of the felt over that without the pedal.
    """

    share: float = 1.0
    felt: float = 1.0

    def hammer(self, hammer: AnyHammer) -> AnyHammer:
        """Return the hammer as the pedal moves it."""
        return hammer if self.felt == 1.0 else hammer._replace(K_H=self.felt * hammer.K_H)

    def weights(self, response: ModalResponse) -> np.ndarray:
        """Amplitudes of modes over those without the pedal [modes], or [1] without it: 1 for aftersound, else `share`.

        A mode is aftersound if it decays more slowly than the geometric mean of the fastest and the slowest of its
        partial, and begins below `LARGEST_AFTERSOUND` times the whole partial. Modes that begin larger cancel each
        other at first, and must keep their proportion.
        """
        if self.share == 1.0:
            return np.ones(1)
        rate = -np.real(response.pole)
        _, partial = np.unique(response.partial, return_inverse=True)
        count = partial.max() + 1
        fastest, slowest = np.zeros(count), np.full(count, np.inf)
        np.maximum.at(fastest, partial, rate)
        np.minimum.at(slowest, partial, rate)
        begin = np.zeros((response.channels, count), complex)
        np.add.at(begin.T, partial, response.pattern.T)
        is_small = (
            np.linalg.norm(response.pattern, axis=0) <= (LARGEST_AFTERSOUND * np.linalg.norm(begin, axis=0))[partial]
        )
        is_slow = rate < np.sqrt(fastest * slowest)[partial] * (1 - 1e-12)
        return np.where(is_slow & is_small, 1.0, self.share)

    def response(self, response: ModalResponse, weight: np.ndarray) -> ModalResponse:
        """Return the response with its modes weighted, and the knock as the prompt sound."""
        if self.share == 1.0:
            return response
        return response._replace(pattern=weight * response.pattern, knock=self.share * response.knock)


def una_corda(midi: int, position: float) -> UnaCorda:
    """Return the effect of the left pedal at a position from 0 (up) to 1 (down)."""
    strings = max(round(typical_strings(midi)), 1)
    struck = strings - position if strings > 1 else 1.0
    return UnaCorda(struck / strings, FELT_RATIO**position)
