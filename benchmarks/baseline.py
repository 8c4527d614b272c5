"""An optimised, compiled implementation of the paper's own algorithm: the baseline of the performance table.

It solves eq. 16-18 with N grid points, Crank-Nicolson, the full duration and one step per sample. Optimisations:

- String and hammer are coupled by one number. The string's velocities without the hammer come from one solve with a
  constant matrix, the force changes them along one fixed vector, and Newton-Raphson has one unknown.
- That matrix is pentadiagonal and factored once. A step consists of the difference stencil, which vectorises, the two
  sweeps of the solve without division, and the update.
- It is compiled for this machine (numba, which only the benchmarks need). Products and sums may be contracted, which
  shortens the dependency chain of the solve.

`python benchmarks/baseline.py` compares it with `tests/finite_difference.py`, which shares no code with it, and times
it.
"""

from __future__ import annotations

import math
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import numba
import numpy as np

TOLERANCE = 1e-9
ROUNDING = 4 * np.finfo(float).eps
MOST_ITERATIONS = 200


class Baseline(NamedTuple):
    """The pre-factored scheme of one string on a grid and of one time step."""

    points: int
    half_step: float  # a = δt/2, s
    factor: np.ndarray  # [points, 3]: 1/d, l1, l2 of L D Lᵀ = 1 + aR + a²K, per unit of mass
    stencil: np.ndarray  # [6]: of K and of R, at the same point, one away, two away
    window: np.ndarray  # h ĝ [points]
    first: int  # points from here
    last: int  # to here, exclusive, lie under the hammer
    answer: np.ndarray  # response of the velocities to a unit of a(F + F_old) [points]
    pickup: np.ndarray  # [2]: point below the pickup and the weight of the next one


def prepared(string: Any, geometry: Any, rate: float, points: int = 100) -> Baseline:
    """Factor the scheme. `string` and `geometry` are those of `pianofit.parameters`."""
    a, h = 0.5 / rate, geometry.length / (points + 1)
    c2, k2 = string.c**2 / h**2, string.kappa**2 / h**4
    stiff = np.array([2 * c2 + 6 * k2, -c2 - 4 * k2, k2])
    loss = np.array([2 * string.b1 + 4 * string.b2 / h**2, -2 * string.b2 / h**2, 0.0])
    bands = np.outer(a**2 * stiff + a * loss + np.array([1.0, 0.0, 0.0]), np.ones(points))
    bands[0, [0, -1]] -= a**2 * k2  # the hinges: y₋₁ = -y₁
    factor = np.zeros((points, 3))
    d, l1, l2 = np.zeros(points), np.zeros(points), np.zeros(points)
    for i in range(points):
        two = bands[2, 0] / d[i - 2] if i > 1 else 0.0
        one = (bands[1, 0] - (two * d[i - 2] * l1[i - 1] if i > 1 else 0.0)) / d[i - 1] if i > 0 else 0.0
        d[i] = bands[0, i] - (one**2 * d[i - 1] if i > 0 else 0.0) - (two**2 * d[i - 2] if i > 1 else 0.0)
        l1[i], l2[i] = one, two
    factor[:, 0], factor[:, 1], factor[:, 2] = 1 / d, l1, l2
    x = h * np.arange(1, points + 1) - geometry.strike_position
    window = np.where(np.abs(x) < geometry.width / 2, 1 + np.cos(2 * np.pi * x / geometry.width), 0.0)
    window /= window.sum()
    struck = np.flatnonzero(window)
    push = window / (geometry.mass / (points + 1))
    answer = push.copy()
    _solve(factor, answer)
    place = geometry.pickup / h - 1
    below = min(max(math.floor(place), 0), points - 2)
    return Baseline(
        points, a, factor, np.append(stiff, loss), window, int(struck[0]), int(struck[-1]) + 1, answer,
        np.array([below, place - below]),
    )  # fmt: skip


def simulate(scheme: Baseline, hammer: Any, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the velocity at the pickup [samples], m/s, and the force [samples], N."""
    return _march(
        scheme.half_step, scheme.factor, scheme.stencil, scheme.window, scheme.first, scheme.last, scheme.answer,
        scheme.pickup, np.array([float(x) for x in hammer]), samples,
    )  # fmt: skip


@numba.njit(cache=True, fastmath={"contract"})
def _solve(factor, x):
    """Solve L D Lᵀ x = b in place; `x` holds b at first."""
    points = len(x)
    one = two = 0.0
    for i in range(points):
        now = (x[i] - factor[i, 2] * two) - factor[i, 1] * one
        x[i] = now
        two, one = one, now
    one = two = l1 = l2 = l2_next = 0.0
    for i in range(points - 1, -1, -1):
        now = (x[i] * factor[i, 0] - l2_next * two) - l1 * one
        x[i] = now
        l1, l2_next, l2 = factor[i, 1], l2, factor[i, 2]
        two, one = one, now


@numba.njit(cache=True, error_model="numpy", fastmath={"contract"})
def _march(a, factor, stencil, window, first, last, answer, pickup, hammer, samples):
    K_H, mu, p, M_H, v_H = hammer
    points = len(window)
    y, v, y_H, force = np.zeros(points + 4), np.zeros(points + 4), 0.0, 0.0
    new = np.zeros(points)
    signal, forces = np.zeros(samples), np.zeros(samples)
    k0, k1, k2 = 2 * a * stencil[0], 2 * a * stencil[1], 2 * a * stencil[2]
    r0, r1 = stencil[3], stencil[4]
    # δv = v' - v solves (1 + aR + a²K) δv = -2a [K (y + a v) + R v] + answer's share of the force.
    meet = 0.0
    for i in range(first, last):
        meet += window[i] * answer[i]
    give = a * a * (meet + 1 / M_H)
    below, weight = int(pickup[0]), pickup[1]
    for n in range(1, samples):
        one = two = 0.0
        y[0], y[points + 3] = -y[2], -y[points + 1]
        v[0], v[points + 3] = -v[2], -v[points + 1]
        for i in range(points):
            j = i + 2
            far = k2 * (y[j - 2] + y[j + 2]) + a * k2 * (v[j - 2] + v[j + 2])
            near = k1 * (y[j - 1] + y[j + 1]) + (a * k1 + 2 * a * r1) * (v[j - 1] + v[j + 1])
            new[i] = -(far + near + k0 * y[j] + (a * k0 + 2 * a * r0) * v[j])
        for i in range(points):
            now = (new[i] - factor[i, 2] * two) - factor[i, 1] * one
            new[i] = now
            two, one = one, now
        one = two = l1 = l2 = l2_next = 0.0
        for i in range(points - 1, -1, -1):
            now = (new[i] * factor[i, 0] - l2_next * two) - l1 * one
            new[i] = now
            l1, l2_next, l2 = factor[i, 1], l2, factor[i, 2]
            two, one = one, now
        # `upper` is the compression if the force were 0 at the end of this step.
        u_old, w_old, under = y_H, v_H, 0.0
        for i in range(first, last):
            u_old -= window[i] * y[i + 2]
            w_old -= window[i] * v[i + 2]
            under += window[i] * (y[i + 2] + a * (2 * v[i + 2] + new[i]))
        upper = y_H + 2 * a * v_H - under - give * force
        old = force
        if upper > 0:
            u = _press(upper, u_old, w_old, give, a, K_H, mu, p)
            force = (upper - u) / give
        else:
            force = 0.0
        total = old + force
        for i in range(points):
            j = i + 2
            change = new[i] + a * total * answer[i]
            y[j] += a * (2 * v[j] + change)
            v[j] += change
        y_H += a * (2 * v_H - a * total / M_H)
        v_H -= a * total / M_H
        forces[n] = force
        signal[n] = (1 - weight) * v[below + 2] + weight * v[below + 3]
    return signal, forces


@numba.njit(cache=True, error_model="numpy")
def _press(upper, u_old, w_old, give, a, K_H, mu, p):
    """Return the root u of u + give F(u) = upper by Newton-Raphson, in the bracket [0, upper]."""
    u = min(max(u_old + 2 * a * w_old, 0.0), upper)
    for _ in range(MOST_ITERATIONS):
        loss = 1 + mu * ((u - u_old) / a - w_old)
        push = slope = 0.0
        if u > 0 and loss > 0:
            stiff = give * K_H * u ** (p - 1)
            push, slope = stiff * u * loss, stiff * (p * loss + u * mu / a)
        left = u - upper + push
        if abs(left) <= ROUNDING * upper:
            break
        u = min(max(u - left / (1 + slope), 0.0), upper)
    return u


@numba.njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc"})
def contacts(g, a, hammers):
    """Return the forces [hammers, steps] of `hammers` [hammers, 5] by the scalar recursion of the modal model.

    Each step sums Σ g_(n-m) T_m over all past forces and solves one equation; g [steps], m/N, is the kernel.
    """
    steps = len(g)
    turned = g[::-1].copy()
    forces = np.zeros((len(hammers), steps))
    drive = np.zeros(steps)
    for h in range(len(hammers)):
        K_H, mu, p, M_H, v_H = hammers[h]
        give = a * a / M_H + g[0]
        u, w, y_H, force = 0.0, v_H, 0.0, 0.0
        for n in range(1, steps):
            under = 0.0
            for m in range(1, n):
                under += turned[steps - 1 - n + m] * drive[m]
            e = y_H + 2 * a * v_H - under
            upper = e - give * force
            new = _press(upper, u, w, give, a, K_H, mu, p) if upper > 0 else upper
            now = (upper - new) / give if upper > 0 else 0.0
            total = now + force
            u, w, force = new, (new - u) / a - w, now
            drive[n] = total
            y_H += a * (2 * v_H - a * total / M_H)
            v_H -= a * total / M_H
            forces[h, n] = now
    return forces


def check(rate: float = 44_100.0, samples: int = 600, points: int = 100) -> float:
    """Return the largest difference from `tests/finite_difference.py`, relative to full scale.

    Raises
    ------
    ValueError
        If the difference exceeds `TOLERANCE`.
    """
    import pianofit

    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    from finite_difference import solve

    preset = pianofit.preset("bensa-final")
    # The pickup lies on a grid point, because the reference interpolates differently between points.
    geometry = preset.geometry._replace(pickup=preset.geometry.length * 30 / (points + 1))
    signal, force = simulate(prepared(preset.string, geometry, rate, points), preset.hammer, samples)
    reference = solve(preset.string, preset.hammer, geometry, step=1 / rate, steps=samples, points=points).signals
    pairs = ((signal, reference.velocity), (force, reference.force))
    worst = max(float(np.abs(x - y).max() / np.abs(y).max()) for x, y in pairs)
    if not worst <= TOLERANCE:
        raise ValueError(f"the baseline differs from the reference by {worst:.1e} of full scale, above {TOLERANCE}")
    return worst


def main() -> None:
    """Compare and time the baseline."""
    import pianofit

    print(f"difference from tests/finite_difference.py: {check():.1e} of full scale")
    preset, times = pianofit.preset("bensa-final"), []
    scheme = prepared(preset.string, preset.geometry, 44_100.0)
    for _ in range(15):
        start = time.perf_counter()
        simulate(scheme, preset.hammer, 44_100)
        times.append(time.perf_counter() - start)
    print(f"{1e3 * min(times):.1f} ms per second of signal at best, {1e6 * min(times) / 44_100:.3f} us per step")


if __name__ == "__main__":
    main()
