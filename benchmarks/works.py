"""What the table times in its own process: strikes, criteria, candidates, sound, and what others do instead."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

# What is timed here and in the processes that it starts is JAX's own float64, as the program's.
os.environ.setdefault("JAX_ENABLE_X64", "1")

RATE = 44_100
# The contact alone: at least 200 steps (whole blocks of 32), modes up to 0.4 of the rate, hammers spread by a factor.
STEPS, MODES, SPREAD, BATCHES = 224, 192, 0.3, (16, 64, 256, 1024)
# On all cores as a search strikes them: batches of this size side by side.
SIDE_BY_SIDE, ALL_CORES = 256, "2048 on all cores"
SCANNED = 64
# Of the objective: points of one call, and what the rows of the default fit are called.
POINTS = 24
HAMMERS, SLOPES, OBJECTIVE = "levels of the prior's hammers", "levels and derivatives", "objective and derivatives"
CSOUND = """<CsoundSynthesizer>
<CsOptions>
-o {out} -W -d -m0
</CsOptions>
<CsInstruments>
sr = 48000
ksmps = 64
nchnls = 1
0dbfs = 1
instr 1
a1 prepiano 65.4, 1, 10, 1, 10, 0.002, 2, 2, 1, 5000, -0.01, 0.12, 20, 0, 0.1, 1, 2
out a1 * 0.5
endin
</CsInstruments>
<CsScore>
f1 0 8 2 1 0.6 10 100 0.001
f2 0 8 2 1 0.7 50 500 1000
i1 0 {seconds}
e
</CsScore>
</CsoundSynthesizer>
"""

Works = dict[str, Callable[[], Any]]


def strikes() -> Works:
    """One strike with 1 s of signal, from parameters to samples: the paper's algorithm compiled, and the program."""
    import baseline

    import pianofit

    it = pianofit.preset("bensa-final")
    return {
        "baseline": lambda: baseline.simulate(baseline.prepared(it.string, it.geometry, RATE), it.hammer, RATE),
        "pianofit": lambda: pianofit.simulate(it.string, it.hammer, it.geometry, rate=RATE).waveform(RATE, RATE),
    }


def criteria(seconds: float = 1.0) -> Works:
    """Eq. 19 of the paper's string against `seconds` of signal, and with nine derivatives.

    The baseline's value is a simulation and one FFT of the damped signal; its nine derivatives are nine more, which is
    what the appendix's sensitivity system costs too.
    """
    import baseline
    import jax
    import jax.numpy as jnp

    import pianofit
    from pianofit.bensa2005.spectral_criterion import (
        SearchConstants,
        StaticConfig,
        criterion_gradients,
        residuals,
        spectral_goal,
    )
    from pianofit.model import contact as contacts
    from pianofit.model import mode_table, spectrum

    it, samples, sigma = pianofit.preset("bensa-final"), round(seconds * RATE), 30.0
    strike = pianofit.simulate(it.string, it.hammer, it.geometry, rate=RATE)
    sound = strike.waveform(RATE, samples)
    contact, modes = 1 / float(strike.modes.step), strike.modes.pole.shape[0]
    f0, B = it.string.c / 2 / it.geometry.length, (it.string.kappa * np.pi / it.string.c / it.geometry.length) ** 2
    goal = spectral_goal(sound, RATE, f0, B, 48, sigma)
    steps = 256 * int(np.ceil(1.6 * strike.last_touch * contact / 256))
    values = np.array([*it.string, *it.hammer], float)
    z = jnp.asarray(np.log(values * 1.01))

    def plain(x: Any) -> Any:
        string, hammer = pianofit.String(*jnp.exp(x[:4])), pianofit.Hammer(*jnp.exp(x[4:]))
        table = mode_table(string, it.geometry, rate=contact, n_modes=modes)
        pulse = contacts.strike(table, hammer, steps=steps)
        y = spectrum(table, pulse.drive, goal.frequency.ravel(), goal.sigma).reshape(goal.frequency.shape)
        return 0.5 * (residuals(y.real**2 + y.imag**2, goal) ** 2).sum()

    value, general = jax.jit(plain), jax.jit(jax.value_and_grad(plain))
    cfg = StaticConfig(modes, steps, "velocity")
    scene = SearchConstants(
        *jax.tree.map(jnp.asarray, (it.geometry, contact, float(np.log(1e-4)), np.array([-99.0, 99.0])))
    )
    searched = jnp.asarray(z).at[4].add(float(np.log(1e-4)) * float(jnp.exp(z[6])))[None]
    damping = np.exp(-sigma * np.arange(samples) / RATE)

    def by_baseline(times: int) -> None:
        for _ in range(times):
            signal, _ = baseline.simulate(baseline.prepared(it.string, it.geometry, RATE), it.hammer, samples)
            float((np.abs(np.fft.rfft(signal * damping)) ** 2).sum())

    return {
        "baseline, value": lambda: by_baseline(1),
        "baseline, nine derivatives": lambda: by_baseline(10),
        "value": lambda: value(z),
        "value and nine derivatives, any model": lambda: general(z),
        "value and nine derivatives": lambda: criterion_gradients(searched, goal, scene, cfg),
    }


def search(files: Sequence[Path], note: str) -> tuple[Works, dict[str, int]]:
    """What the default fit evaluates of these recordings, on all cores, and how large it is.

    Levels of the prior's hammers, one string for all; levels and all derivatives of one call's hammers; and the
    objective with its derivatives at as many points.
    """
    import pianofit
    from pianofit.inference import build_problem
    from pianofit.inference.batched_model import BATCH_SIZE, level_jacobians, run_in_batches
    from pianofit.inference.derivatives import evaluate
    from pianofit.inference.multistart import initial_hyperparameters, sobol_samples
    from pianofit.inference.objective import Objective
    from pianofit.inference.pipeline import fit_string

    recordings = [pianofit.load_recording(x) for x in files]
    problem = build_problem(recordings, [pianofit.analyse(one, note=note) for one in recordings], pianofit.Setup())
    string, table = fit_string(problem).theta[0, :4], problem.observed.level
    held = Objective.of_levels(problem, string)
    model, z = held.level_model, sobol_samples(held, 0)
    many, some = model.stroke_entries(z), model.stroke_entries(z)[:BATCH_SIZE]
    people = held.start(z[:POINTS], [initial_hyperparameters(table)])
    at = *people.level[:4], people.theta
    sizes = {
        "recordings": len(files), "hammers": len(many), "lanes": len(some), "points": len(people),
        "modes": model.cfg.n_modes, "steps": int(model.inputs.steps),
        "partials": int(np.asarray(problem.observed.level.detected).sum()),
    }  # fmt: skip
    return {
        HAMMERS: lambda: model.levels(many),
        SLOPES: lambda: run_in_batches(level_jacobians, (string, some), model.inputs, model.cfg, BATCH_SIZE),
        OBJECTIVE: lambda: evaluate(table, *at),
    }, sizes


def shares(file: Path, note: str) -> dict[str, float]:
    """Seconds of each stage of a warm fit, and of the whole, from the file to the numbers."""
    import pianofit

    begun: list[tuple[str, float]] = []
    for _ in range(2):  # the second is warm
        begun[:] = [("reading", time.perf_counter())]
        recording = pianofit.load_recording(file)
        analysis = pianofit.analyse(recording, note=note)
        pianofit.fit(
            recording, analyses=[analysis], progress=lambda stage, _: begun.append((stage, time.perf_counter()))
        )
        begun.append(("", time.perf_counter()))
    spent: dict[str, float] = {}
    for (stage, start), (_, stop) in pairwise(begun):
        spent[stage] = spent.get(stage, 0.0) + stop - start
    return spent | {"whole": begun[-1][1] - begun[0][1]}


def hammers(batch: int, seed: int = 0) -> Any:
    """Hammers about the paper's, every parameter spread by a factor; fields [batch]."""
    import jax.numpy as jnp

    import pianofit

    hammer = np.asarray(pianofit.preset("bensa-final").hammer)
    spread = np.exp(SPREAD * np.random.default_rng(seed).standard_normal((batch, 5)))
    return pianofit.Hammer(*(jnp.asarray(x) for x in hammer[:, None] * spread.T))


def contact_batch(modes: int = MODES, steps: int = STEPS) -> Callable:
    """Compiled: forces [batch, steps] of hammers on one string, contact only."""
    import jax

    import pianofit
    from pianofit.model import contact, mode_table

    it = pianofit.preset("bensa-final")
    table = mode_table(it.string, it.geometry, rate=float(RATE), n_modes=modes)
    # Where the model can carry the past in the string's kernel, all hammers share it.
    rows = getattr(contact, "kernel_rows", None)
    shared = {} if rows is None else {"rows": rows(table, steps)}
    return jax.jit(jax.vmap(lambda hammer: contact.strike(table, hammer, steps=steps, **shared).force))


def candidates() -> Works:
    """Hammers on one string, contact only: by the batch, and one by one in C's place."""
    import baseline
    import jax

    import pianofit
    from pianofit.inference.batched_model import thread_pool
    from pianofit.model import kernel, mode_table

    it = pianofit.preset("bensa-final")
    scheme = baseline.prepared(it.string, it.geometry, RATE)
    table = mode_table(it.string, it.geometry, rate=float(RATE), n_modes=MODES)
    g = np.asarray(kernel(table, STEPS))
    sixty_four = np.stack([np.asarray(x) for x in hammers(64)], axis=1)
    run = contact_batch()
    batches = {size: hammers(size) for size in BATCHES}
    one = pianofit.Hammer(*(x[:1] for x in batches[BATCHES[0]]))
    works: Works = {
        "baseline, 1 s": lambda: baseline.simulate(scheme, it.hammer, RATE),
        "same recursion compiled, 64": lambda: baseline.contacts(g, 0.5 / RATE, sixty_four),
        "alone": lambda: run(one),
    }
    works |= {f"{size} together": lambda x=x: run(x) for size, x in batches.items()}
    parts = [batches[SIDE_BY_SIDE]] * (int(ALL_CORES.split()[0]) // SIDE_BY_SIDE)
    return works | {ALL_CORES: lambda: list(thread_pool().map(lambda x: jax.block_until_ready(run(x)), parts))}


def sounds(seconds: float = 10.0, rate: int = 48_000) -> Works:
    """A struck C2, recorded at the bridge through a path, from parameters to samples."""
    import pianofit
    from pianofit.model.output_path import OutputPath

    it = pianofit.preset("chabassier-C2")
    path = OutputPath(np.array([50.0, 500.0, 5000.0]), np.array([-20.0, 0.0, -10.0]))
    note = pianofit.Note(it.string, it.hammer, it.geometry, "pressure", 1.0, path)
    works: Works = {"pianofit": lambda: note.render_stroke(rate, round(seconds * rate))}
    if shutil.which("csound"):
        works["csound prepiano"] = lambda: _csound(seconds)
    return works


def _csound(seconds: float) -> None:
    """A whole process, as csound is used; starting it takes a few hundredths of a second."""
    with tempfile.TemporaryDirectory() as folder:
        score = Path(folder) / "piano.csd"
        score.write_text(CSOUND.format(out=Path(folder) / "piano.wav", seconds=seconds))
        subprocess.run(["csound", str(score)], check=True, capture_output=True)


def plain_scan() -> Works:
    """A linear string of 64 modes over 1 s in plain `lax.scan`, with and without its gradient."""
    import jax
    import jax.numpy as jnp

    k = jnp.arange(1.0, SCANNED + 1)

    def energy(values: Any) -> Any:
        f0, b1, b2 = values
        turn = jnp.exp((-(b1 + b2 * k**2) + 2j * jnp.pi * f0 * k) / RATE)

        def step(state: Any, _: Any) -> Any:
            real, imag = state
            real, imag = turn.real * real - turn.imag * imag, turn.real * imag + turn.imag * real
            return (real, imag), real.sum()

        return (jax.lax.scan(step, (1 / k, jnp.zeros(SCANNED)), None, length=RATE)[1] ** 2).sum()

    values = jnp.array([100.0, 0.5, 1e-3])
    forward, backward = jax.jit(energy), jax.jit(jax.value_and_grad(energy))
    return {"forward": lambda: forward(values), "with gradient": lambda: backward(values)}
