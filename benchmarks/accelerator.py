"""Hammer candidates by the ten thousand, on whatever device JAX chooses: `python benchmarks/accelerator.py`.

The program has no code of its own for an accelerator. This script runs there unchanged, in float64: candidates a second
for growing batches, and the largest batch before memory ends.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from typing import Any

import works

FIRST, MOST = 1024, 2**26
# Batches grow by this factor until one fails, or a run takes longer than this, s.
GROWTH, LONGEST = 4, 20.0


def measure_accelerator(*, anyway: bool = False, first: int = FIRST, most: int = MOST) -> dict[str, Any] | None:
    """Candidates a second by batch, and the largest batch; None where JAX has only the CPU, unless `anyway`."""
    import jax

    device = jax.devices()[0]
    if device.platform == "cpu" and not anyway:
        return None
    rates: dict[int, float] = {}
    batch, ended = first, "the largest tried"
    while batch <= most:
        try:
            seconds = _seconds(batch)
        except jax.errors.JaxRuntimeError as error:
            if "RESOURCE_EXHAUSTED" not in str(error):
                raise
            ended = "memory"
            break
        rates[batch] = batch / seconds
        if seconds > LONGEST:
            ended = "the longest run allowed"
            break
        batch *= GROWTH
    return {
        "device": str(device.device_kind), "platform": device.platform, "rates": rates,
        "largest batch": max(rates, default=0), "ended by": ended, "memory": _memory(device),
    }  # fmt: skip


def _seconds(batch: int) -> float:
    import jax

    run, many = works.contact_batch(), works.hammers(batch)
    jax.block_until_ready(run(many))
    taken = []
    for _ in range(5):
        start = time.perf_counter()
        jax.block_until_ready(run(many))
        taken.append(time.perf_counter() - start)
        if sum(taken) > LONGEST:
            break
    return statistics.median(taken)


def _memory(device: Any) -> int | None:
    """Bytes that JAX may use there, where it says."""
    return (device.memory_stats() or {}).get("bytes_limit")


def main() -> None:
    """Measure and print JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--anyway", action="store_true", help="on the CPU too")
    parser.add_argument("--first", type=int, default=FIRST, help="batch to begin with")
    parser.add_argument("--most", type=int, default=MOST, help="batch to end with")
    arguments = parser.parse_args()
    found = measure_accelerator(anyway=arguments.anyway, first=arguments.first, most=arguments.most)
    print(json.dumps(found, indent=1) if found else "JAX has only the CPU here; --anyway measures that")


if __name__ == "__main__":
    main()
