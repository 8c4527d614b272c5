"""A few damaged files of every kind that is read, each read or refused: the long search is `benchmarks/fuzz.py`."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

FUZZ = Path(__file__).parents[1] / "benchmarks" / "fuzz.py"
# Cases of each kind.
COUNT, SEED = 40, 20


def test_damaged_files_are_read_or_refused_in_one_line_that_names_them():
    """In a process of its own, because the fuzzer limits memory and time of its process."""
    command = [sys.executable, str(FUZZ), "--count", str(COUNT), "--seed", str(SEED)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    lines = done.stdout.splitlines()
    assert lines[-1].startswith("0 faults")
    tried = {line.partition(":")[0] for line in lines[:-1] if f" {COUNT} cases, 0 faults" in line}
    assert tried >= {"wav", "flac", "setup", "fit", "note", "keys", "instrument", "midi", "sfz", "csv", "extras"}
