"""Is the model computed right? Orders of accuracy, invariants and independent witnesses, as a page with figures.

    python benchmarks/validation.py                 writes docs/validation.md and docs/validation-*.png
    python benchmarks/validation.py --out folder    writes them there

Nothing on the page is written by hand but its words. The cases and the slow witnesses are those of the tests, which
hold each of these numbers to a limit; here they are measured.
"""

from __future__ import annotations

import argparse
import importlib
import math
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from pianofit import model
from pianofit.model.free_response import damped_circle
from pianofit.model.x64 import x64_scope
from pianofit.parameters import FIT_NAMES, Hammer

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests"))
cases, references = importlib.import_module("model_cases"), importlib.import_module("reference_cases")
energy, fast_path = importlib.import_module("test_model_energy"), importlib.import_module("test_reference")
STRING, HAMMER, GEOMETRY, RATE = cases.STRING, cases.HAMMER, cases.GEOMETRY, cases.RATE
WIDE, relative = references.WIDE, references.relative

LIGHT = Hammer(K_H=1.1e10, mu=0.1, p=2.5, M_H=1e-3, v_H0=2.0)
LINEAR = Hammer(K_H=5e4, mu=0.0, p=1.0, M_H=1e-3, v_H0=2.0)
MODES, SAMPLES, LINEAR_SAMPLES = 16, 90, 30  # at RATE; the linear felt is still pressed at its last sample
FACTORS = tuple(2**i for i in range(8))  # steps per sample
STEP = 5e-6  # of central differences, in the logarithm: see tests/test_model_gradients.py


def number(x: float) -> str:
    """Two digits."""
    return f"{x:.1e}"


def table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """Return a Markdown table."""
    return "\n".join("| " + " | ".join(line) + " |" for line in (head, ("---",) * len(head), *rows))


def with_orders(errors: list[float] | np.ndarray) -> list[str]:
    """Each error, from the second on with log2 of how much smaller it is than the one before."""
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    return [number(errors[0]), *(f"{number(e)} ({o:.2f})" for e, o in zip(errors[1:], orders, strict=True))]


def draw(path: Path, panels: list[tuple[str, dict[str, tuple[np.ndarray, np.ndarray]]]]) -> None:
    """Errors over what is below each panel: curves of x and y by label."""
    mpl.rcParams.update({"font.size": 8, "axes.spines.top": False, "axes.spines.right": False})
    figure = Figure(figsize=(7.2, 3.0), layout="constrained")
    for ax, (below, curves) in zip(figure.subplots(1, len(panels)), panels, strict=True):
        for (label, (x, y)), mark in zip(curves.items(), "os^d", strict=False):
            ax.loglog(x, y, f"{mark}-", label=label, markersize=3, linewidth=1)
        ax.set(xlabel=below, ylabel="largest error, of full scale")
        ax.tick_params(which="minor", labelbottom=False, labelleft=False)
        ax.grid(alpha=0.3, linewidth=0.5)
        ax.legend(frameon=False)
    figure.savefig(path, dpi=120)


def exact(rows, hammer: Hammer, geometry, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Force and pickup velocity of the modal equations of motion, not discretised in time: DOP853 at 1e-12."""
    found = cases.exact_contact(*rows, hammer, times)
    k = np.arange(1, found.v.shape[1] + 1)
    return found.force, found.v @ np.sin(k * math.pi * geometry.pickup / geometry.length)


def continuous_rows(n: int, geometry, weights=None):
    """ω², α, Φ and γ of the continuous string's first modes [n]."""
    beta = np.arange(1, n + 1) * math.pi / geometry.length
    phi = cases.table(STRING, geometry, rate=RATE * 1024, n_modes=n).strike if weights is None else weights
    omega2, alpha = STRING.c**2 * beta**2 + STRING.kappa**2 * beta**4, STRING.b1 + STRING.b2 * beta**2
    return omega2, alpha, np.asarray(phi), 2 * np.asarray(phi) / geometry.mass


def stepped(hammer: Hammer, factor: int, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Force and pickup velocity of the fast path at `factor` steps a sample, at the samples."""
    steps = -(-factor * samples // 32) * 32
    modes, pulse = cases.hit(STRING, hammer, GEOMETRY, RATE * factor, n_modes=MODES, steps=steps)
    velocity = model.waveform(modes, pulse.drive, rate=RATE * factor, samples=steps)
    return np.asarray(pulse.force)[::factor][:samples], np.asarray(velocity)[::factor][:samples]


def extrapolated(signals: list[np.ndarray], truth: np.ndarray) -> list[float]:
    """Errors of Romberg's diagonal: what is left if the step's even powers are taken off one by one."""
    diagonal, row = [], []
    for signal in signals:
        new = [signal]
        for j, old in enumerate(row, 1):
            new.append(new[-1] + (new[-1] - old) / (4**j - 1))
        row = new
        diagonal.append(relative(row[-1], truth))
    return diagonal


def in_time(out: Path) -> str:
    """Order in the step, against the equations of motion."""
    truth = exact(continuous_rows(MODES, GEOMETRY), LIGHT, GEOMETRY, np.arange(SAMPLES) / RATE)
    errors = [[relative(x, e) for x, e in zip(stepped(LIGHT, f, SAMPLES), truth, strict=True)] for f in FACTORS]
    force, velocity = np.array(errors).T
    truth = exact(continuous_rows(MODES, GEOMETRY), LINEAR, GEOMETRY, np.arange(LINEAR_SAMPLES) / RATE)
    pulses = [stepped(LINEAR, f, LINEAR_SAMPLES)[0] for f in FACTORS]
    linear, floor = [relative(x, truth[0]) for x in pulses], extrapolated(pulses, truth[0])
    columns = (with_orders(list(force)), with_orders(list(velocity)), with_orders(linear), map(number, floor))
    step = 1e6 / RATE / np.array(FACTORS)
    rows = [(f"{s:.3f}", *errors) for s, *errors in zip(step, *columns, strict=True)]
    left = {"force": (step, force), "pickup velocity": (step, velocity)}
    right = {"force": (step, np.array(linear)), "extrapolated": (step, np.array(floor))}
    draw(out / "validation-time.png", [("step, µs (felt of p = 2.5)", left), ("step, µs (linear felt)", right)])
    return f"""## Order in time

{MODES} modes of the continuous string and the hammer's contact, stepped by the fast path, against the same modes'
equations of motion under a Runge–Kutta solver of order 8 at a tolerance of 1e-12. Errors are the largest, of full
scale; in brackets the observed order of that halving, expected 2.0 ± 0.1. With a linear felt the error is a series in
even powers of the step, and its extrapolation (Romberg) shows the floor that rounding and the solver leave.

{table(("step, µs", "force, p = 2.5", "pickup velocity, p = 2.5", "force, linear felt", "extrapolated"), rows)}

![Errors over the step](validation-time.png)
"""


def in_space(out: Path) -> str:
    """Accuracy in the number of modes and in the grid's spacing, both without any step in time."""
    times = np.arange(SAMPLES) / RATE
    # A Gaussian has no kink; this one is as wide at half its height as the raised cosine.
    smooth = model.window_weights(lambda x: jnp.exp(-0.5 * (4.71 * x / WIDE.width) ** 2), WIDE._replace(width=0.2), 192)
    every = {"raised cosine": continuous_rows(192, WIDE), "smooth window": continuous_rows(192, WIDE, smooth)}
    truth = {name: exact(rows, LIGHT, WIDE, times) for name, rows in every.items()}
    counts, errors = np.array([8, 16, 32, 48, 64, 96, 128]), {}
    for name, rows in every.items():
        found = [exact([x[:n] for x in rows], LIGHT, WIDE, times) for n in counts]
        errors[name] = np.array([[relative(x, e) for x, e in zip(f, truth[name], strict=True)] for f in found]).T
    modes = [(str(n), *(number(errors[name][j][i]) for name in every for j in (0, 1))) for i, n in enumerate(counts)]
    spaces = np.array([50, 100, 200, 400])
    on_grid = []
    for n in spaces - 1:
        grid = cases.table(STRING, WIDE, rate=RATE, n_modes=int(n), kind="finite_difference")
        rows = [np.asarray(x) for x in (grid.omega2, grid.alpha, grid.strike, grid.drive)]
        found = exact(rows, LIGHT, WIDE, times)
        on_grid.append([relative(x, e) for x, e in zip(found, truth["raised cosine"], strict=True)])
    force, velocity = np.array(on_grid).T
    grids = list(zip(map(str, spaces), with_orders(list(force)), with_orders(list(velocity)), strict=True))
    left = {f"force, {name}": (counts, errors[name][0]) for name in every}
    right = {"force": (spaces, force), "pickup velocity": (spaces, velocity)}
    draw(out / "validation-space.png", [("modes", left), ("spaces of the grid", right)])
    heads = tuple(f"{kind}, {name}" for name in every for kind in ("force", "velocity"))
    return f"""## Number of modes, and the grid

Here nothing is discretised in time; the truth is the continuous string with 192 modes. A table converges as its contact
window is smooth: spectrally for a Gaussian, down to the solver's floor, and in the end with a power of the number of
modes for the default raised cosine, whose curvature jumps at its ends.

{table(("modes", *heads), modes)}

The paper's grid of N + 1 spaces is of second order (in brackets; expected 2 as soon as the grid resolves the window).

{table(("spaces", "force", "pickup velocity"), grids)}

![Errors over the number of modes and over the grid](validation-space.png)
"""


def drift(kind: str) -> float:
    """Largest relative change of a free lossless string's energy in ten seconds at 44.1 kHz, looked at 700 times."""
    n = 24
    modes = cases.table(energy.LOSSLESS, GEOMETRY, rate=44_100.0, n_modes=n, kind=kind)
    start = (1e-3 / np.arange(1, n + 1) ** 2, np.zeros(n))
    columns = [energy._step(modes, q, v, 0.0) for q, v in ((np.ones(n), np.zeros(n)), (np.zeros(n), np.ones(n)))]
    block = np.linalg.matrix_power(np.stack([np.stack(c, axis=-1) for c in columns], axis=-1), 630)
    state, worst = np.stack(start, axis=-1)[..., None], 0.0
    for _ in range(700):
        state = block @ state
        now = energy._energy(modes, state[:, 0, 0], state[:, 1, 0])
        worst = max(worst, abs(now / energy._energy(modes, *start) - 1))
    return worst


def largest_rise(steps: int = 10_000) -> float:
    """Largest relative change of energy in a single step of a lossy free string; below 0: a fall."""
    modes, random = cases.table(STRING, GEOMETRY, rate=RATE, n_modes=64), np.random.default_rng(0)
    states = [(random.normal(size=64) * 1e-3, random.normal(size=64))]
    for _ in range(steps):
        states.append(energy._step(modes, *states[-1], 0.0))
    kept = np.array([energy._energy(modes, *state) for state in states])
    return float(np.max(kept[1:] / kept[:-1] - 1))


def energies() -> str:
    """Energy: kept, falling, and lost in the felt."""
    losses = (0.0, 0.01, 0.1, 1.0)
    work = [[energy._felt_work(HAMMER._replace(mu=mu), RATE * f, 8192) for f in (1, 4)] for mu in losses]
    rows = [(f"{mu:g}", *map(number, pair)) for mu, pair in zip(losses, work, strict=True)]
    return f"""## Energy

- Free lossless string, ten seconds at 44.1 kHz: the energy drifts by {number(drift("continuous"))} of itself at most,
  on the paper's grid by {number(drift("finite_difference"))}.
- Free string with losses, 10,000 steps from a random state: the energy changes by {number(largest_rise())} of itself in
  a step at most, which must not be above 0.

Net work of the felt's loop from first to last touch, of the hammer's energy. Without losses it is the scheme's error,
which falls with the square of the step; with losses it must be positive.

{table(("μ, s/m", f"at {RATE / 1e3:g} kHz", f"at {4 * RATE / 1e3:g} kHz"), rows)}
"""


def reciprocity() -> str:
    """Strike and pickup trade places."""
    k, here, there = np.arange(1, 65) * math.pi / GEOMETRY.length, 0.12, 0.37
    tables = [
        cases.table(STRING, GEOMETRY._replace(pickup=heard), rate=RATE, n_modes=64, strike_weights=np.sin(hit * k))
        for hit, heard in ((here, there), (there, here))
    ]
    zeta = damped_circle(jnp.linspace(20, 15_000, 300), 30.0, tables[0].step)
    forth, back = (model.mobility(modes, zeta) for modes in tables)
    return f"""## Reciprocity

A point force at {here:g} m heard at {there:g} m, and the other way round, 20 Hz to 15 kHz: the responses differ by
{number(relative(back, forth))} of the largest.
"""


def central_differences(case: dict, window: np.ndarray) -> dict[str, dict[str, np.ndarray]]:
    """Derivatives of the fast path's signals by the logarithm of each parameter."""

    def at(name: str, sign: int) -> dict:
        part = "string" if name in case["string"]._fields else "hammer"
        moved = case[part]._replace(**{name: getattr(case[part], name) * math.exp(sign * STEP)})
        return fast_path._fast(case | {part: moved}, window)[0]

    return {name: jax.tree.map(lambda a, b: (a - b) / (2 * STEP), at(name, 1), at(name, -1)) for name in FIT_NAMES}


def witnesses() -> str:
    """Gradients by three witnesses, and the fast path against the paper's scheme."""
    case, kinds = references.CASES["paper"][0], ("velocity", "force")
    slow = references.solve(case, derivatives=True)
    tangents, differences = fast_path._fast(case, slow.window)[1], central_differences(case, slow.window)
    values = case["string"]._asdict() | case["hammer"]._asdict()
    gradients = []
    for name in FIT_NAMES:
        fast, other = tangents[name], slow.derivatives[name]
        row = [relative(fast[kind], getattr(other, kind)) for kind in kinds]
        row += [relative(fast[kind] * values[name], differences[name][kind]) for kind in kinds]
        row += [np.abs(fast[kind]).max() * values[name] / np.abs(getattr(slow.signals, kind)).max() for kind in kinds]
        gradients.append((f"`{name}`", *map(number, row)))
    shown, signals = (*kinds, "compression"), []
    for name, (each, _) in references.CASES.items():
        slow = references.solve(each)
        fast = fast_path._fast(each, slow.window)[0]
        signals.append((name, *(number(relative(fast[kind], getattr(slow.signals, kind))) for kind in shown)))
    against = tuple(f"{kind}, {other}" for other in ("appendix", "differences", "size") for kind in kinds)
    return f"""## Gradients by three witnesses

Derivatives of the pickup velocity and of the force by the nine parameters, a string like the paper's on a grid of
{references.POINTS} points, {references.STEPS} steps: forward mode through the fast path (`jax.jvp`), against the
paper's appendix (`paper/scheme.py`), and against central differences of {STEP:g} in the logarithm. The
largest difference, of the largest value of that derivative. The size is that of the derivative by the logarithm, of
full scale: what differences leave is rounding over their step, a large share where a parameter hardly acts.

{table(("by", *against), gradients)}

## Fast path against reference

The table of modes with one scalar equation a step, against the paper's grid with its matrices and a Newton iteration
over the whole system. They share nothing but the parameters' names. The largest difference, of full scale.

{table(("case", *shown), signals)}
"""


def main() -> None:
    """Compute and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "docs")
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    head = """# Validation

Made by `python benchmarks/validation.py`, which computes every number and figure here; run it again after a change of
the model. Rounding differs a little from one machine to the next. The tests hold the same quantities to limits.
"""
    studied = "`benchmarks/annealing_study.py` and [annealing.md](annealing.md)"
    annealing = f"## Annealing\n\nThe annealing's success rates: {studied}.\n"
    parts = [head, in_time(out), in_space(out), energies(), reciprocity(), witnesses(), annealing]
    (out / "validation.md").write_text("\n".join(parts), encoding="utf-8")


if __name__ == "__main__":
    with x64_scope():
        main()
