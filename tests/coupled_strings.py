"""Two strings of a unison on one bridge by finite differences: a reference for modes that shares no code with them.

Each string moves across and along the soundboard. So there are four stiff lines of masses and springs, hinged at one
end. All end on a bridge of two degrees of freedom, each with a mass, a spring and a damper, coupled by a spring. The
strings are mistuned, and polarisations differ slightly in tension, so a partial has four modes. Some decay fast,
because the bridge absorbs their energy, some slowly, because the bridge hardly moves. Poles are the eigenvalues of the
system matrix. The sound is computed without them, by powers of the matrix exponential. SI units.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg
import scipy.signal

POINTS = 24  # masses on a line
LENGTH, DENSITY = 0.62, 6e-3  # m, kg/m
KAPPA = 2.0  # m²/s
LOSS, DRAG = 0.25, 2e-5  # b1, 1/s, and b2, m²/s
STRIKE = 0.12  # of the length
# The lines: frequency over that of the first line, direction of the bridge, and share of the stroke.
LINES = ((1.0, 0, 1.0), (1.002, 0, 0.8), (1.0008, 1, 0.2), (1.0022, 1, 0.1))
# The bridge across and along the soundboard: mass, kg; frequency, Hz; damping, kg/s; weight of its velocity.
BRIDGE = ((0.08, 600.0, 400.0, 1.0), (0.6, 900.0, 400.0, 3.0))
COUPLED = 0.3  # stiffness between both directions over the geometric mean of theirs


class Unison:
    """The matrix A of z' = A z + push F, with output read z; z holds displacements, then velocities."""

    def __init__(self, f0: float, bridge: tuple[tuple[float, float, float, float], ...] = BRIDGE):
        h, free = LENGTH / (POINTS + 1), 4 * POINTS + 2
        mass, stiff, lossy = np.full(free, DENSITY * h), np.zeros((free, free)), np.zeros((free, free))
        push, read = np.zeros(2 * free), np.zeros(2 * free)
        for line, (ratio, direction, share) in enumerate(LINES):
            own = np.arange(line * POINTS, (line + 1) * POINTS)
            stretch = np.zeros((POINTS + 1, free))
            stretch[np.arange(POINTS + 1), [*own, 4 * POINTS + direction]] = 1
            stretch[np.arange(1, POINTS + 1), own] -= 1
            bend = np.diff(stretch, axis=0)
            tension = DENSITY * (2 * LENGTH * f0 * ratio) ** 2
            stiff += tension / h * stretch.T @ stretch + DENSITY * KAPPA**2 / h**3 * bend.T @ bend
            lossy += 2 * DENSITY * DRAG / h * stretch.T @ stretch
            lossy[own, own] += 2 * LOSS * DENSITY * h
            push[free + own[round(STRIKE * (POINTS + 1)) - 1]] = share / (DENSITY * h)
        ends = 4 * POINTS + np.arange(2)
        mass[ends], frequency, damping, read[free + ends] = np.array(bridge).T
        spring = mass[ends] * (2 * np.pi * frequency) ** 2
        stiff[ends, ends] += spring
        stiff[ends, ends[::-1]] += COUPLED * np.sqrt(spring.prod())
        lossy[ends, ends] += damping
        self.A = np.block([[np.zeros((free, free)), np.eye(free)], [-stiff / mass[:, None], -lossy / mass[:, None]]])
        self.push, self.read = push, read

    def poles(self) -> np.ndarray:
        """Poles of all modes, 1/s, complex."""
        return scipy.linalg.eigvals(self.A)

    def response(self, rate: float, count: int) -> np.ndarray:
        """Sound after an impulse of 1 N s [count]."""
        step, block = scipy.linalg.expm(self.A / rate), int(np.sqrt(count)) + 1
        rows = [self.read]
        for _ in range(block):
            rows.append(rows[-1] @ step)
        within, jump = np.array(rows[:-1]), np.linalg.matrix_power(step, block)
        state, out = self.push, []
        for _ in range(-(-count // block)):
            out.append(within @ state)
            state = jump @ state
        return np.concatenate(out)[:count]


def stroke(impulse: np.ndarray, rate: float, velocity: float) -> np.ndarray:
    """Sound of a force pulse, by the response to an impulse; a harder stroke has a shorter and higher pulse."""
    t = np.arange(0.0, 0.003 * velocity**-0.3, 1 / rate)
    force = velocity * np.sin(np.pi * t / (t[-1] + 1 / rate)) ** 2 / rate
    return scipy.signal.oaconvolve(impulse, force)[: len(impulse)]


class StringsOnBridge:
    """Strings across one resistive bridge, at the end x = L of each; motion and energy of their partials over time.

    The bridge has one degree of freedom, without a spring and with hardly a mass. The matrix exponential over one step
    is taken to powers. Stiff or not, each string is a line of masses with hinged ends.
    """

    POINTS, LENGTH, DENSITY, LOSS = 40, 0.62, 6e-3, 0.2  # masses; m; kg/m; b1, 1/s
    BRIDGE_MASS = 1e-5  # kg

    def __init__(self, f0: tuple[float, ...], resistance: float):
        n, count = self.POINTS, len(f0)
        h, free = self.LENGTH / (n + 1), count * n + 1
        self.mass, stiff, lossy = np.full(free, self.DENSITY * h), np.zeros((free, free)), np.zeros((free, free))
        for line, frequency in enumerate(f0):
            own = np.arange(line * n, (line + 1) * n)
            stretch = np.zeros((n + 1, free))
            stretch[np.arange(n + 1), [*own, count * n]] = 1
            stretch[np.arange(1, n + 1), own] -= 1
            stiff += self.tension(frequency) / h * stretch.T @ stretch
            lossy[own, own] += 2 * self.LOSS * self.DENSITY * h
        self.mass[-1], lossy[-1, -1] = self.BRIDGE_MASS, resistance
        self.A = np.block([
            [np.zeros((free, free)), np.eye(free)],
            [-stiff / self.mass[:, None], -lossy / self.mass[:, None]],
        ])  # fmt: skip
        self.f0, self.stiff, self.resistance = f0, stiff, resistance

    def tension(self, f0: float) -> float:
        """Tension of a string, N."""
        return self.DENSITY * (2 * self.LENGTH * f0) ** 2

    def pole(self, line: int, k: int) -> complex:
        """Pole of partial k of a string if it is alone on this bridge, 1/s."""
        alone = StringsOnBridge((self.f0[line],), self.resistance)
        poles = scipy.linalg.eigvals(alone.A)
        return sorted(poles[poles.imag > 1], key=lambda pole: pole.imag)[k - 1]

    def impulse(self, line: int, place: float) -> np.ndarray:
        """State after an impulse of 1 N s at a place, a fraction of the length, on one string."""
        state = np.zeros(2 * len(self.mass))
        at = line * self.POINTS + round(place * (self.POINTS + 1)) - 1
        state[len(self.mass) + at] = 1 / self.mass[at]
        return state

    def motion(self, state: np.ndarray, seconds: float, count: int) -> np.ndarray:
        """States at `count` times `seconds` apart, from time 0 on [times, states]."""
        step = scipy.linalg.expm(self.A * seconds)
        states = [state]
        for _ in range(count - 1):
            states.append(step @ states[-1])
        return np.array(states)

    def amplitude(self, states: np.ndarray, line: int, k: int, omega: float) -> np.ndarray:
        """√(M/2) ω C of partial k for a displacement Re(C), complex [times]."""
        n, own = self.POINTS, np.arange(line * self.POINTS, (line + 1) * self.POINTS)
        shape = np.sin(np.pi * k * np.arange(1, n + 1) / (n + 1)) * 2 / (n + 1)
        # The end moves with the bridge: the straight line to it is no part of a mode.
        straight = np.outer(states[:, len(self.mass) - 1], np.arange(1, n + 1) / (n + 1))
        q = (states[:, own] - straight) @ shape
        velocity = states[:, len(self.mass) + own] @ shape
        return np.sqrt(self.DENSITY * self.LENGTH / 2) * (omega * q - 1j * velocity)

    def energy(self, states: np.ndarray) -> np.ndarray:
        """Energy of strings and bridge, J [times]."""
        free = len(self.mass)
        q, v = states[:, :free], states[:, free:]
        return 0.5 * np.einsum("ti,ij,tj->t", q, self.stiff, q) + 0.5 * v**2 @ self.mass
