"""Not only pianos: a plucked string, fitted with a model of its own.

All that a fit needs of a model is its parameters with bounds, and a function from them to a spectrum on the damped
circle, Y = ∫ y exp(-(σ + jω)t) dt, written in JAX. Here a guitar's A string is pulled aside by a fingertip and let go;
a magnetic pickup hears its velocity, in no known unit. The recording is made by a twin, sample by sample and with
noise. Found are where it was plucked and how broad the finger was, beside the string's own four parameters.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array

import pianofit

LENGTH, PICKUP = 0.65, 0.52  # m, measured with a ruler, from the bridge's end
MODES = 40
RATE, SECONDS, LEAD = 22_050, 3.0, 0.1
NOISE_DB = 60.0  # below the first second's rms
TRUE = {"c": 143.0, "kappa": 0.42, "b1": 0.9, "b2": 4e-4, "pluck": 0.13, "width": 0.022}


def released(pluck, width, xp=jnp):
    """Modal amplitudes [modes] of a string drawn to a triangle, rounded over `width`: y = Σ q_k sin(β_k x)."""
    k = xp.arange(1, MODES + 1)
    beta, s = k * (np.pi / LENGTH), k * width / LENGTH / 2
    rounded = xp.sinc(s) + 0.5 * xp.sinc(s + 1) + 0.5 * xp.sinc(s - 1)  # a raised cosine
    return 2 * xp.sin(beta * pluck) / (beta**2 * pluck * (LENGTH - pluck)) * rounded


def poles(c, kappa, b1, b2, xp=jnp):
    """-α + jω of every mode, 1/s [modes]."""
    s = (xp.arange(1, MODES + 1) * (np.pi / LENGTH)) ** 2
    alpha = b1 + b2 * s
    return -alpha + 1j * xp.sqrt(c**2 * s + kappa**2 * s**2 - alpha**2)


def heard(values, xp=jnp):
    """The pickup's velocity is Re Σ A exp(pt): A and p, complex [modes]. Each mode starts at rest, from q."""
    c, kappa, b1, b2, pluck, width = values
    p = poles(c, kappa, b1, b2, xp)
    amplitude = released(pluck, width, xp) * xp.sin(xp.arange(1, MODES + 1) * (np.pi / LENGTH) * PICKUP)
    # v = dq/dt with q(0) = 1 and v(0) = 0: Re((j |p|²/ω) exp(pt)).
    return 1j * xp.abs(p) ** 2 / p.imag * amplitude, p


def spectrum(values: Array, frequency: Array, sigma: Array) -> Array:
    """Y, complex [bins]: Re(A exp(pt)) transforms to (A/(s - p) + Ā/(s - p̄))/2."""
    amplitude, p = heard(values)
    s = (sigma + 2j * jnp.pi * frequency)[:, None]
    return 0.5 * (amplitude / (s - p) + amplitude.conj() / (s - p.conj())).sum(axis=1)


def record(seed: int = 0) -> pianofit.Recording:
    """The twin: silence, then the note, and noise over both."""
    amplitude, p = heard(TRUE.values(), np)
    t = np.arange(round(SECONDS * RATE)) / RATE
    note = np.zeros(len(t))
    for a, pole in zip(amplitude, p, strict=True):
        note += (a * np.exp(pole * t)).real
    note = np.pad(note / (2 * np.abs(note).max()), (round(LEAD * RATE), 0))
    rms = np.sqrt(np.mean(note[round(LEAD * RATE) :][:RATE] ** 2))
    noise = np.random.default_rng(seed).normal(0.0, rms * 10 ** (-NOISE_DB / 20), len(note))
    return pianofit.recording_from_samples(note + noise, RATE, name="guitar A2")


def main() -> None:
    """Fit, and print the truth beside what was found."""
    recording = record()
    analysis = pianofit.analyse(recording, note="A2")
    model = pianofit.SoundModel(
        names=tuple(TRUE),
        # Plucked at x or at L - x a string has the same levels, so it was in the first part.
        lower=(100.0, 1e-3, 1e-2, 1e-8, 0.03, 0.002),
        upper=(200.0, 10.0, 20.0, 1e-1, 0.30, 0.060),
        spectrum=spectrum,
    )
    # The string starts where the analysis puts it, the pluck at a guess.
    c = 2 * LENGTH * analysis.f0
    start = {"c": c, "kappa": c * LENGTH * analysis.B**0.5 / np.pi, "b1": analysis.b1,
             "b2": analysis.d2 * (LENGTH / np.pi) ** 2, "pluck": 0.2, "width": 0.01}  # fmt: skip
    found = pianofit.fit_model(model, recording, analysis, start, spread={"pluck": 0.4, "width": 0.5})
    print(f"{'':6}{'start':>12}{'true':>12}{'found':>12}   95 % interval")
    for name, value in found.values.items():
        span = found.intervals[name]
        shown = "-" if span is None else f"[{span[0]:.6g}, {span[1]:.6g}]"
        print(f"{name:6}{start[name]:12.6g}{TRUE[name]:12.6g}{value:12.6g}   {shown}")
    print(f"criterion {found.cost:.2e}, misfit {found.misfit:.2f} times the noise, converged: {found.converged}")
    print("\n".join(found.messages))


if __name__ == "__main__":
    main()
