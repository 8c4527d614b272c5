"""Wrong types: every public function raises a PianofitError that names the argument."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path


def test_a_wrong_type_is_refused_by_the_name_of_its_argument():
    """In a separate process, because here a type checker intercepts the calls."""
    program = Path(__file__).with_name("wrong_types.py")
    done = subprocess.run([sys.executable, program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert not done.stdout, done.stdout
