"""What a fit does, in numbers that do not depend on the machine: `python benchmarks/counts.py [--seconds S]`.

Programs traced, compiled and kept, strikes of the model, the contact's rate, steps and modes, for a fit of a made note
with empty caches. Prints JSON. `tests/test_counts.py` fails when they grow.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

COMPILED = "/jax/core/compile/backend_compile_duration"
TRACED = "/jax/core/compile/jaxpr_trace_duration"
# Programs that step the contact: seconds to compile, each.
PHYSICS = ("levels", "level_jacobians", "levels_per_string", "level_jacobians_per_string")


def counts(seconds: float, noise_db: float | None = 30.0) -> dict[str, Any]:
    """Of one fit of the demo's synthetic recording, cut after `seconds`, in a process that is fresh."""
    import jax

    events: Counter = Counter()
    jax.monitoring.register_event_duration_secs_listener(lambda event, *_, **__: events.update([event]))
    import pianofit
    from pianofit.analysis import analyse
    from pianofit.inference import InferenceResult, build_problem, map_estimate
    from pianofit.program_folder import enable_program_cache
    from pianofit.result import build_result
    from pianofit.synthetic import demo_recording

    twin = demo_recording(noise_db)
    enable_program_cache()
    recording = pianofit.recording_from_samples(twin.samples[: twin.onset + int(seconds * twin.rate)], twin.rate)
    found = analyse(recording)
    events.clear()
    problem = build_problem([recording], [found], twin.setup)
    fit = map_estimate(problem)
    searched = dict(events)
    build_result(InferenceResult(problem, fit, 0))
    names = [path.name.split("-")[1] for path in Path(os.environ["PIANOFIT_CACHE"]).glob("*.program")]
    return {
        "compilations": searched[COMPILED], "traces": searched[TRACED], "kept_programs": len(names),
        "physics": sum(name in PHYSICS for name in names),
        "compilations_of_the_result": events[COMPILED] - searched[COMPILED],
        "strikes": fit.n_strokes_computed, "contact_rate_Hz": round(float(problem.model_inputs.rate), 6),
        "modes": problem.cfg.n_modes, "steps": int(problem.model_inputs.steps),
        "partials": int(np.asarray(problem.observed.level.detected).sum()), "minima": len(fit.minima.nll),
    }  # fmt: skip


def main() -> None:
    """Count and print, in a cache folder of its own that is empty."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=1.0, help="of the measurement that is fitted")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as cache:
        os.environ["PIANOFIT_CACHE"] = cache
        os.environ.pop("JAX_COMPILATION_CACHE_DIR", None)
        print(json.dumps(counts(arguments.seconds), indent=1))


if __name__ == "__main__":
    main()
