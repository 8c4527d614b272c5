"""A fit in a process of its own, its caches empty: what it does must not grow unnoticed, and the caller's JAX stays."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest
from float32_caller import environment

# `python benchmarks/counts.py --seconds 0.6` prints these, of a process of its own with empty caches. A limit lies a
# little above what it prints now; where a change is worth more work, raise it knowingly.
LIMITS = {
    "compilations": 7,  # 5 now: the physics, and a small one
    "compilations_of_the_result": 5,  # 2
    "traces": 11,  # 9
    "kept_programs": 12,  # 11: the physics, two strikes and their sound; the rest is the caller's own
    "physics": 4,  # levels and slopes with one string; slopes with own ones; own levels at a finer step
    "strikes": 19_000,  # 17717, of which 16384 are the prior's hammers at all velocities
    "contact_rate_Hz": 88_200,  # a finer step is read off as a correction of levels
    "modes": 128,
    "steps": 1024,
}


FIT = """
import json, os, sys
os.environ["PIANOFIT_CACHE"] = sys.argv[1]
os.environ.pop("JAX_COMPILATION_CACHE_DIR", None)
import counts
from float32_caller import state
from pianofit.program_folder import enable_program_cache
enable_program_cache()
before = state()
found = counts.counts(0.6)
after = state()
changed = [name for name, value in before[0].items() if after[0][name] != value]
print(json.dumps(found | {"changed settings": changed, "same results": before[1] == after[1]}))
"""


@pytest.fixture(scope="module")
def counts(tmp_path_factory) -> dict[str, float]:
    """Of the demo's fit, between two runs of a caller's own program."""
    arguments = [sys.executable, "-c", FIT, str(tmp_path_factory.mktemp("cache"))]
    done = subprocess.run(arguments, capture_output=True, text=True, timeout=600, env=environment())
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_a_float32_program_is_the_same_before_and_after_a_fit(counts):
    assert counts["changed settings"] == []
    assert counts["same results"]


@pytest.mark.parametrize("name", LIMITS)
def test_a_fit_does_no_more_than_it_did(counts, name):
    assert 0 < counts[name] <= LIMITS[name]


def test_what_is_counted_was_a_whole_fit(counts):
    # A fit that gives up early would pass every limit.
    assert counts["partials"] >= 15
    assert counts["strikes"] >= 16384
    assert counts["minima"] >= 1
