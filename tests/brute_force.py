"""A struck string by brute force: an independent reference for the tests, which shares no code with the package.

The package expands the string in sines and steps them with Crank-Nicolson. Here the wave equation is stepped directly,

    y_tt = c² y_xx − κ² y_xxxx − 2 b1 y_t + 2 b2 y_txx + g(x) F / (M_S/L),     y = y_xx = 0 at both ends,

on a grid of a few hundred points with sixteenth-order central differences (odd beyond the hinged ends), in displacement
and velocity, with the classical Runge-Kutta scheme at 16 times the sample rate. The hammer is integrated together with
the string. The default contact window is a parabola. After the last contact the motion is the exact exponential of the
matrix of the same grid, whose eigenvectors are computed numerically. A linear-phase anti-alias filter converts the
output to the sample rate.

Everything is in SI units. `string`, `hammer` and `geometry` are any objects with the fields c, kappa, b1, b2; K_H, mu,
p, M_H, v_H0; length, mass, strike_position, width, pickup.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg
import scipy.signal

HALF = 8  # points on either side in a difference stencil: of order 16 for second derivatives
OVERSAMPLING = 16
MAX_CONTACT = 0.25  # s

WINDOWS = {  # of z = (x - x0)/width in [-1/2, 1/2], unit area over z
    "parabola": lambda z: 1.5 * (1 - 4 * z**2),
    "box": lambda z: np.ones_like(z),
    "triangle": lambda z: 2 * (1 - 2 * np.abs(z)),
    "biweight": lambda z: 1.875 * (1 - 4 * z**2) ** 2,
    "raised-cosine": lambda z: 1 + np.cos(2 * np.pi * z),
}


def matched_width(window: str, width: float) -> float:
    """The full width that gives `window` the variance of a raised cosine of full width `width`."""
    z = (np.arange(20_000) + 0.5) / 20_000 - 0.5
    variance = {name: float(np.mean(shape(z) * z**2)) for name, shape in WINDOWS.items()}
    return width * math.sqrt(variance["raised-cosine"] / variance[window])


def stencil(derivative: int, half: int = HALF) -> np.ndarray:
    """Central difference weights on the points -half..half of spacing 1."""
    points = np.arange(-half, half + 1.0)
    powers = np.vander(points, increasing=True).T
    return np.linalg.solve(powers, math.factorial(derivative) * (np.arange(2 * half + 1) == derivative))


def fold(points: int, positions: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Weights at any integer positions of the odd, periodic continuation, as a row on the points 1..N."""
    period = 2 * (points + 1)
    at = np.mod(positions, period)
    mirrored = at > points + 1
    full = np.bincount(
        np.where(mirrored, period - at, at), weights=np.where(mirrored, -weights, weights), minlength=points + 2
    )
    return full[1 : points + 1]


@functools.cache
def eigen(points: int, h: float) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues and eigenvectors of minus the second-difference matrix, found numerically."""
    offsets = np.arange(-HALF, HALF + 1)
    matrix = np.stack([fold(points, i + offsets, -stencil(2) / h**2) for i in range(1, points + 1)])
    return scipy.linalg.eigh(matrix)


class Grid:
    """The string as points x_i = i h, i = 1..N, and the linear maps on them."""

    def __init__(self, string: Any, geometry: Any, points: int, window: str):
        self.N, self.h = points, geometry.length / (points + 1)
        self.density = geometry.mass / geometry.length
        second = stencil(2) / self.h**2
        fourth = np.convolve(second, second)
        self.pull = -(string.kappa**2) * fourth
        self.pull[HALF:-HALF] += string.c**2 * second
        self.drag = 2 * string.b2 * second
        self.drag[HALF] -= 2 * string.b1
        self.window = self._window(geometry, window)
        self.string = string

    def interpolation(self, x: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """The row that gives Σ weights · y(x), by local polynomials of degree 15."""
        base = np.floor(x / self.h).astype(int)
        nodes = np.arange(-7, 9)
        s = (x / self.h - base)[:, None]
        lagrange = np.ones((x.size, nodes.size))
        for i, a in enumerate(nodes):
            for b in nodes[nodes != a]:
                lagrange[:, i] *= (s[:, 0] - b) / (a - b)
        return fold(self.N, (base[:, None] + nodes).ravel(), (weights[:, None] * lagrange).ravel())

    def _window(self, geometry: Any, name: str) -> np.ndarray:
        z = (np.arange(2000) + 0.5) / 2000 - 0.5
        return self.interpolation(geometry.strike_position + geometry.width * z, WINDOWS[name](z) / z.size)

    def pickup(self, quantity: str, geometry: Any) -> np.ndarray:
        """The row that reads the output from the displacements (or, for velocity, from the velocities)."""
        if quantity != "bridge-force":
            return self.interpolation(np.array([geometry.pickup]), np.ones(1))
        end = self.N + 1 + np.arange(-HALF, HALF + 1)
        slope, third = stencil(1) / self.h, stencil(3) / self.h**3
        tension = -self.density * (self.string.c**2 * slope - self.string.kappa**2 * third)
        return fold(self.N, end, tension)


@dataclass(frozen=True)
class Strike:
    """Result of the stepping, at the fine rate, and the free exponentials that follow it."""

    rate: float  # of the steps, Hz
    output: np.ndarray  # at 0, dt, ... while the hammer may touch
    force: np.ndarray  # N
    compression: np.ndarray  # m; negative when apart
    energy: np.ndarray  # J: string, hammer and felt, at every step
    lost: np.ndarray  # J: dissipated by string and felt up to each step
    poles: np.ndarray  # 1/s, complex, of the free motion
    amplitudes: np.ndarray  # output(t) = Re Σ amplitudes · exp(poles · (t − time of the last step))

    def free(self, times: np.ndarray) -> np.ndarray:
        """The output `times` seconds after the last step, equally spaced times only."""
        block = 256
        step = times[1] - times[0] if times.size > 1 else 0.0
        inner = np.exp(np.outer(self.poles, step * np.arange(block)))
        starts = np.exp(np.outer(times[::block], self.poles)) * self.amplitudes
        return (starts @ inner).real.ravel()[: times.size]


class _Contact:
    """Runge-Kutta steps of string and hammer together."""

    def __init__(self, grid: Grid, hammer: Any, geometry: Any, dt: float, quantity: str):
        self.grid, self.hammer, self.dt = grid, hammer, dt
        self.push = grid.window / (grid.h * grid.density)
        self.read = grid.pickup(quantity, geometry)
        self.of_velocity = quantity == "velocity"
        self.y, self.v = np.zeros(grid.N), np.zeros(grid.N)
        self.y_H, self.v_H, self.lost = 0.0, float(hammer.v_H0), 0.0
        self.trace: list[tuple[float, ...]] = []

    def _odd(self, y: np.ndarray, pad: int) -> np.ndarray:
        wide = np.zeros(y.size + 2 * pad)
        wide[pad:-pad] = y
        wide[: pad - 1] = -y[pad - 2 :: -1]
        wide[-pad + 1 :] = -y[:-pad:-1]
        return wide

    def rates(self, y: np.ndarray, v: np.ndarray, y_H: float, v_H: float) -> tuple[Any, ...]:
        """(y', v', y_H', v_H', power lost), and the force and compression."""
        window, hammer = self.grid.window, self.hammer
        u, du = y_H - window @ y, v_H - window @ v
        elastic = hammer.K_H * u**hammer.p if u > 0 else 0.0
        F = max(elastic * (1 + hammer.mu * du), 0.0)
        drag = np.correlate(self._odd(v, HALF + 1)[1:-1], self.grid.drag, "valid")
        pull = np.correlate(self._odd(y, 2 * HALF + 1)[1:-1], self.grid.pull, "valid")
        power = -self.grid.density * self.grid.h * (v @ drag) + (F - elastic) * du
        return (v, pull + drag + self.push * F, v_H, -F / hammer.M_H, power), F, u, pull

    def record(self, F: float, u: float, pull: np.ndarray) -> None:
        hammer, cell = self.hammer, self.grid.density * self.grid.h
        energy = 0.5 * cell * (self.v @ self.v - self.y @ pull) + 0.5 * hammer.M_H * self.v_H**2
        energy += hammer.K_H * max(u, 0.0) ** (hammer.p + 1) / (hammer.p + 1)
        self.trace.append((self.read @ (self.v if self.of_velocity else self.y), F, u, energy, self.lost))

    def advance(self, steps: int) -> None:
        """Advance by `steps`. The state at the start of each step is recorded, so the last state is not."""
        state = (self.y, self.v, self.y_H, self.v_H, self.lost)
        for _ in range(steps):
            k1, F, u, pull = self.rates(*state[:4])
            self.record(F, u, pull)
            k2 = self.rates(*(s + 0.5 * self.dt * k for s, k in zip(state[:4], k1, strict=False)))[0]
            k3 = self.rates(*(s + 0.5 * self.dt * k for s, k in zip(state[:4], k2, strict=False)))[0]
            k4 = self.rates(*(s + self.dt * k for s, k in zip(state[:4], k3, strict=False)))[0]
            state = tuple(
                s + self.dt / 6 * (a + 2 * b + 2 * c + d) for s, a, b, c, d in zip(state, k1, k2, k3, k4, strict=True)
            )
            self.y, self.v, self.y_H, self.v_H, self.lost = state


def _exponentials(grid: Grid, row: np.ndarray, y: np.ndarray, v: np.ndarray, of_velocity: bool) -> tuple[Any, Any]:
    """Poles and amplitudes of row·y(t), or of row·v(t), of the free grid from the state (y, v)."""
    s, vectors = eigen(grid.N, grid.h)
    alpha = grid.string.b1 + grid.string.b2 * s
    root = np.sqrt((alpha**2 - grid.string.c**2 * s - grid.string.kappa**2 * s**2).astype(complex))
    poles = np.stack([-alpha + root, -alpha - root])
    q, dq, r = vectors.T @ y, vectors.T @ v, vectors.T @ row
    amplitudes = r * np.stack([(dq - poles[1] * q) / (2 * root), -(dq - poles[0] * q) / (2 * root)])
    if of_velocity:
        amplitudes = amplitudes * poles
    return poles.ravel(), amplitudes.ravel()


def _can_touch(contact: _Contact) -> bool:
    """Return true if the free hammer would touch the free string within half a second."""
    grid = contact.grid
    poles, amplitudes = _exponentials(grid, grid.window, contact.y, contact.v, False)
    times = np.arange(0.0, 0.5, 2e-5)
    keep = poles.imag >= 0
    string = Strike(0, *(np.zeros(0),) * 5, poles[keep], 2 * amplitudes[keep]).free(times)
    return bool(np.any(contact.y_H + contact.v_H * times >= string))


def strike(
    string: Any, hammer: Any, geometry: Any, *, rate: float, quantity: str, window: str = "parabola", points: int = 240
) -> Strike:
    """Simulate one strike with `rate` steps a second, until the hammer has left the string for good."""
    grid = Grid(string, geometry, points, window)
    contact = _Contact(grid, hammer, geometry, 1 / rate, quantity)
    s_max = float(np.sum(np.abs(stencil(2)))) / grid.h**2
    fastest = math.sqrt(string.c**2 * s_max + string.kappa**2 * s_max**2) / rate
    if fastest > 2.5:
        raise ValueError(f"{rate:g} steps a second are unstable on {points} points: ω dt = {fastest:.2f}")
    block = max(int(1e-3 * rate), 8)
    while True:
        contact.advance(block)
        if contact.y_H < grid.window @ contact.y and not _can_touch(contact):
            break
        if len(contact.trace) > MAX_CONTACT * rate:
            raise ValueError(f"the hammer has not left the string after {MAX_CONTACT} s")
    poles, amplitudes = _exponentials(grid, contact.read, contact.y, contact.v, contact.of_velocity)
    return Strike(rate, *np.array(contact.trace).T, poles, amplitudes)


def low_pass(rate: float) -> np.ndarray:
    """A linear-phase filter at the fine rate: flat to 0.44 of the sample rate, 90 dB attenuation from 0.54 on."""
    width = 0.1 / (OVERSAMPLING / 2)
    taps, beta = scipy.signal.kaiserord(90.0, width)
    return scipy.signal.firwin(taps | 1, 0.49 * rate, window=("kaiser", beta), fs=OVERSAMPLING * rate)


def _decimated(
    string: Any, hit: Strike, samples: int, lead: int, rate: float, glide: float, glide_seconds: float
) -> np.ndarray:
    """The filtered output at the sample rate, after `lead` fine steps of silence."""
    fir = low_pass(rate)
    half = fir.size // 2
    stepped = hit.output.size
    first_free = min(samples, -(-(stepped + lead + half) // OVERSAMPLING))
    tail = hit.free(np.arange(2 * half + 2 * OVERSAMPLING) / hit.rate)
    fine = np.concatenate([np.zeros(lead + half), hit.output, tail])
    early = scipy.signal.oaconvolve(fine, fir, "valid")[::OVERSAMPLING][:first_free]
    # From here on the filter input is exponentials, and the filter multiplies each by a number.
    times = (np.arange(first_free, samples) * OVERSAMPLING - lead - stepped) / hit.rate
    keep = hit.poles.imag > -np.pi * rate * 1.2
    keep &= hit.poles.imag < np.pi * rate * 1.2
    poles, offsets = hit.poles[keep], np.arange(-half, half + 1) / hit.rate
    filtered = hit.amplitudes[keep] * (np.exp(np.outer(poles, offsets)) @ fir)
    free = Strike(hit.rate, *(np.zeros(0),) * 5, poles, filtered)
    late = _gliding(string, free, times, glide, glide_seconds) if glide else free.free(times)
    return np.concatenate([early, late])


def _gliding(string: Any, free: Strike, times: np.ndarray, ratio: float, seconds: float) -> np.ndarray:
    """The exponentials while the wave speed falls from the simulated one to 1/ratio of it, at a constant stiffness."""
    behind = (1 - 1 / ratio) * (times - seconds * (1 - np.exp(-times / seconds)))
    up = free.poles.imag > 0
    poles, amplitudes = free.poles[up], 2 * free.amplitudes[up]
    # ω² = c² s + κ² s²; the tension's share of it is c² s/ω².
    s = 2 * poles.imag**2 / (string.c**2 + np.sqrt(string.c**4 + (2 * string.kappa * poles.imag) ** 2))
    turn = poles.imag * string.c**2 * s / poles.imag**2
    out = np.empty(times.size)
    for start in range(0, times.size, 4096):
        part = slice(start, start + 4096)
        # Exponentials 240 dB below the strongest are left out: they are most of all, and most of the cost.
        rings = np.abs(amplitudes) * np.exp(poles.real * times[start]) > 1e-12 * np.abs(amplitudes).max()
        phase = np.outer(times[part], poles[rings]) - 1j * np.outer(behind[part], turn[rings])
        out[part] = (np.exp(phase) @ amplitudes[rings]).real
    return out


def output_path(rate: float, decibels: float, seed: int, taps: int = 1024) -> np.ndarray:
    """A smooth minimum-phase filter whose level varies by `decibels` (rms) over frequency."""
    random = np.random.default_rng(seed)
    f = np.abs(np.fft.fftfreq(4 * taps, 1 / rate))
    octaves = np.log2(np.maximum(f, 20.0) / 20.0)
    shape = sum(random.normal() * np.cos(2 * np.pi * (n * octaves / 10 + random.random())) for n in range(1, 7))
    level = decibels * (shape - np.mean(shape)) / np.std(shape)
    cepstrum = np.fft.ifft(level / 20 * np.log(10)).real
    cepstrum[1 : 2 * taps] *= 2
    cepstrum[2 * taps + 1 :] = 0
    return np.fft.ifft(np.exp(np.fft.fft(cepstrum))).real[:taps]


class _Scaled:
    """`base` with some of its fields replaced."""

    def __init__(self, base: Any, **fields: float):
        self.c, self.kappa, self.b1, self.b2 = base.c, base.kappa, base.b1, base.b2
        for name, value in fields.items():
            setattr(self, name, value)


@functools.cache
def _clean(
    string: Any, hammer: Any, geometry: Any, samples: int, rate: int, quantity: str, lead: int, glide_cents: float,
    glide_seconds: float, beating_cents: float, beating_level: float, window: str, points: int,
) -> np.ndarray:  # fmt: skip
    ratio = 2 ** (glide_cents / 1200)
    planes = [(1.0, ratio)] + ([(beating_level, ratio * 2 ** (beating_cents / 1200))] if beating_cents else [])
    out = np.zeros(samples)
    for level, r in planes:
        plane = _Scaled(string, c=string.c * r, kappa=string.kappa * r / ratio)
        hit = strike(plane, hammer, geometry, rate=OVERSAMPLING * rate, quantity=quantity, window=window, points=points)
        out += level * _decimated(plane, hit, samples, lead, rate, ratio if glide_cents else 0.0, glide_seconds)
    out.flags.writeable = False
    return out


def make_synthetic_recording(
    string: Any, hammer: Any, geometry: Any, *, seconds: float, rate: int, quantity: str, noise_db: float | None = None,
    seed: int = 0, lead_in: float = 0.0, glide_cents: float = 0.0, glide_seconds: float = 0.7,
    beating_cents: float = 0.0, beating_level: float = 0.3, path_db: float = 0.0, window: str = "parabola",
    points: int = 240,
) -> np.ndarray:  # fmt: skip
    """A recording of one strike, in SI units, `seconds` long at `rate`, of which the first `lead_in` are silence.

    `quantity` is "velocity", "displacement" (both at the pickup), "bridge-force", or "pressure": the force on the
    bridge through an unknown path, whose level varies by `path_db` (default 3 dB). `noise_db` is the level of white
    noise relative to the rms of the first second of the note. The wave speed starts `glide_cents` above that of
    `string` and falls with the time constant `glide_seconds`. `beating_cents` adds a second polarisation.
    """
    source = "bridge-force" if quantity == "pressure" else quantity
    lead = round(lead_in * rate * OVERSAMPLING)
    samples = round(seconds * rate)
    clean = _clean(string, hammer, geometry, samples, rate, source, lead, glide_cents, glide_seconds, beating_cents,
                   beating_level, window, points)  # fmt: skip
    out = clean.copy()
    if path_db or quantity == "pressure":
        out = scipy.signal.oaconvolve(out, output_path(rate, path_db or 3.0, seed + 1000))[:samples]
    if noise_db is not None:
        onset = lead // OVERSAMPLING
        rms = math.sqrt(np.mean(out[onset : onset + rate] ** 2))
        out += 10 ** (noise_db / 20) * rms * np.random.default_rng(seed).normal(size=samples)
    return out
