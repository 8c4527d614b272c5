"""Modes of strings that stand on one bridge: how they exchange energy.

Each mode has an amplitude a whose square is twice its energy. Alone on the bridge it decays at its pole, p. The bridge,
of real admittance Y, adds

    da_i/dt = p_i a_i - v_i Σ_j v_j a_j        j: modes of other strings,   v_i = ± √α_i,   α = (T/L) Y

α is what a mode loses to the bridge, so its own losses determine the coupling. Two equal strings have Weinreich's
symmetric coupling, -α. The sign is (-1)^(k+1), that of the force of partial k on the bridge. The matrix of losses, with
-Re p on its diagonal and v_i v_j elsewhere, has no negative eigenvalue as long as Σ α/(-Re p) <= 1 over the modes of
each partial. Then energy never rises.

Modes far apart in frequency exchange little, and only the begin of a vibration excites them. So the coupling has two
parts by the taper τ, which falls linearly from 1 for equal frequencies to 0 at `TAPER`. The part τ is solved in steps
of time. The part 1 - τ acts once, at a stroke, in closed form (`far_response`). The taper is a positive definite
function of the difference of frequencies. So the tapered matrix has no negative eigenvalue either (Schur's product
theorem).
"""

import numpy as np
from scipy import sparse

# Difference of angular frequencies beyond which modes are coupled by strokes alone, rad/s. A quarter tone at 1 kHz lies
# within. At this distance a step of time is half a turn, and the taper is 0.
TAPER = 2 * np.pi * 45.0
# Struck modes whose far response is computed at once: the arrays of this many fit into a processor cache.
ROWS_AT_ONCE = 8
# Most of its loss that a partial can give to the bridge: a margin, so that steps of time cannot create energy.
MOST_BRIDGE_SHARE = 0.95


class CoupledModes:
    """Modes of strings on one bridge.

    Parameters
    ----------
    pole : of each mode alone on the bridge, in ascending order of frequency, complex, 1/s [modes].
    drive : v, √(1/s) [modes].
    string : number of the string, or of the unison, of each mode. Its modes are not coupled with each other, because
        their poles are those that they have together on the bridge [modes].
    common : share of the motion of the bridge at one string that other strings share, 0 to 1. It is 1 for strings at
        one point.
    receives : 0 for a mode to which other strings add nothing, else 1 [modes], or one value for all. Such a mode decays
        at its pole and drives the others. The energy that these have among themselves never rises.
    """

    def __init__(
        self,
        pole: np.ndarray,
        drive: np.ndarray,
        string: np.ndarray,
        common: float = 1.0,
        receives: np.ndarray | float = 1.0,
    ) -> None:
        self.pole, self.drive = pole, drive
        self.received = common * np.asarray(receives)  # share of the bridge's motion that acts on each mode
        omega = np.imag(pole)
        self._omega = omega / TAPER
        self._above, self._below, self._twice = 1 + self._omega, 1 - self._omega, 2 * self._omega
        self._left = np.searchsorted(omega, omega - TAPER)
        self._right = np.searchsorted(omega, omega + TAPER, side="right")
        self._own = _own_taper(np.imag(pole), string)

    def exchange(self, amplitude: np.ndarray, lift: np.ndarray) -> np.ndarray:
        """v_i Σ_j v_j τ_ij a_j over modes j of other strings, complex [modes].

        `lift` multiplies v: 0 for a string whose damper rests on it, 1 for a free string [modes].

        The taper is linear on both sides. So each sum follows from running sums over the modes in order of frequency.
        """
        drive, omega, left, right = self.drive * lift, self._omega, self._left, self._right
        driven = drive * amplitude
        sums, moments = np.zeros((2, len(driven) + 1), complex)
        np.cumsum(driven, out=sums[1:])
        np.cumsum(driven * omega, out=moments[1:])
        total = sums.take(right) * self._above - sums.take(left) * self._below - self._twice * sums[1:]
        total += 2 * moments[1:] - moments.take(left) - moments.take(right)
        total -= (self._own @ driven.view(float).reshape(-1, 2)).view(complex)[:, 0]
        return self.received * drive * total

    def step(
        self, alone: np.ndarray, added: np.ndarray, half: np.ndarray, lift: np.ndarray, seconds: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Advance by one step of time, of second order.

        Parameters
        ----------
        alone : amplitudes that the modes would have without each other, complex [modes].
        added : what the other modes have added to them, complex [modes].
        half : factor of each amplitude over half of the step, complex [modes].
        lift : as for `exchange`.
        seconds : the step, s.

        Returns
        -------
        Both amplitudes after the step.
        """
        alone, added = alone * half, added * half
        first = self.exchange(alone + added, lift)
        added = added - seconds * first + 0.5 * seconds**2 * self.exchange(first, lift)
        return alone * half, added * half

    def far_response(self, source: np.ndarray, strength: np.ndarray) -> np.ndarray:
        """Amplitudes of all modes after an impulse of force that starts the modes `source`, complex [modes].

        Parameters
        ----------
        source : indices of the struck modes; they get nothing themselves [struck].
        strength : their amplitudes after the impulse, complex [struck].

        A vibration Re(A e^{qt}) from t = 0 on has half the transform A/(s - q) + A*/(s - q*). The rule above has twice
        the force of a real motion. At the pole of another mode it gives the amplitude of that mode. The response to any
        force is this times the transform of the force at the pole.
        """
        q, weight, pole = self.pole[source], self.drive[source] * strength, self.pole
        # w/(s - q) + w*/(s - q*) = (2 Re w s - 2 Re w q*)/(s² - 2 Re q s + |q|²)
        numerator = np.stack([2 * np.real(weight), -2 * np.real(weight * np.conj(q))])
        near = np.searchsorted(np.imag(pole), [np.imag(q) - TAPER, np.imag(q) + TAPER]).T
        real, imag = np.zeros((2, 2, len(pole)))  # of both terms of the numerator, divided
        for first in range(0, len(q), ROWS_AT_ONCE):
            rows = slice(first, first + ROWS_AT_ONCE)
            # Parts of the denominator, (s - Re q)² + (Im q)², and the square of its size. Real arithmetic is faster.
            x = np.real(pole) - np.real(q[rows, None])
            re, im = x**2 - np.imag(pole) ** 2 + np.imag(q[rows, None]) ** 2, 2 * np.imag(pole) * x
            size = re**2 + im**2
            size[size == 0] = 1.0  # equal poles, which have no part in it
            np.reciprocal(size, out=size)
            for row, omega, (left, right) in zip(size, np.imag(q[rows]), near[rows], strict=True):
                row[left:right] *= np.abs(np.imag(pole[left:right]) - omega) / TAPER
            real += numerator[:, rows] @ (re * size)
            imag -= numerator[:, rows] @ (im * size)
        total = pole * (real[0] + 1j * imag[0]) + real[1] + 1j * imag[1]
        total[source] = 0.0
        return -self.received * self.drive * total


def bridge_drive(rate: np.ndarray, decay: np.ndarray, share: np.ndarray, partial: np.ndarray) -> np.ndarray:
    """|v| of modes, √(1/s) [modes].

    Parameters
    ----------
    rate : rate at which the partial loses energy to the bridge right after a stroke, 1/s [modes].
    decay : decay rate of each mode, 1/s [modes].
    share : share of each mode in its partial; the shares of a partial sum to 1 [modes].
    partial : number that modes of one partial of one string share, and no others [modes].

    A partial cannot give more to the bridge than it loses: Σ share rate/decay is at most `MOST_BRIDGE_SHARE`.
    """
    _, index = np.unique(partial, return_inverse=True)
    taken = np.bincount(index, rate * share / decay)[index]
    return np.sqrt(share * rate * np.minimum(1.0, MOST_BRIDGE_SHARE / np.maximum(taken, 1e-300)))


def _own_taper(omega: np.ndarray, string: np.ndarray) -> sparse.csr_array:
    """τ between modes of the same string, and 0 elsewhere [modes, modes]."""
    rows, columns = [], []
    for number in np.unique(string):
        own = np.flatnonzero(string == number)
        near = np.abs(np.subtract.outer(omega[own], omega[own])) < TAPER
        row, column = np.nonzero(near)
        rows.append(own[row])
        columns.append(own[column])
    row, column = np.concatenate(rows), np.concatenate(columns)
    taper = 1 - np.abs(omega[row] - omega[column]) / TAPER
    return sparse.csr_array((taper, (row, column)), shape=(len(omega), len(omega)))
