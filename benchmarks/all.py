#!/usr/bin/env python
"""Every study of docs/benchmarks.md, one after the other.

    python benchmarks/all.py [WORD...] [--set NAME=VALUE...] [--list] [--out build/benchmarks] [--times]

The commands are those of the tables on that page, which is their only list. A WORD keeps the commands that contain
it. Names in capitals, such as INSTRUMENT.JSON or FITS, are replaced by `--set INSTRUMENT.JSON=path`; a name with dots,
such as RECORDINGS..., by several words. Commands with a
name that has no value are skipped and listed. The output of each goes to a file with the commit, the machine, the load
and the time that it took. `--times` writes commit and time into the last column of the page as well.
"""

from __future__ import annotations

import argparse
import os
import platform
import re
import shlex
import subprocess
import sys
import time
from pathlib import Path

from measuring import commit

ROOT = Path(__file__).parent.parent
PAGE = ROOT / "docs" / "benchmarks.md"
# A command in the first cell of a row, and a name to be replaced.
COMMAND = re.compile(r"^\| `(python [^`]+)`", re.MULTILINE)
NAME = re.compile(r"^[A-Z][A-Z.]+(\.\.\.)?$")
# Times below are written in seconds, others in minutes.
SHORT_S = 90.0


def commands(words: list[str], values: dict[str, str]) -> tuple[dict[str, list[str]], list[str]]:
    """Return the commands to run, by their text on the page, with values in place of names; and those without."""
    ready, lacking = {}, []
    for text in COMMAND.findall(PAGE.read_text(encoding="utf-8")):
        if words and not any(word in text for word in words):
            continue
        parts = [word for part in shlex.split(text) for word in _words(part, values)]
        if any(NAME.match(part) for part in parts):
            lacking.append(text)
        else:
            ready[text] = [sys.executable, *parts[1:]]
    return ready, lacking


def _words(part: str, values: dict[str, str]) -> list[str]:
    """Return a part of a command, or the value of a name. NAME... takes several words."""
    name = part.removesuffix("...")
    if name == part or name not in values:
        return [values.get(name, part)]
    return shlex.split(values[name])


def origin() -> str:
    """Return commit, machine and load as lines."""
    load = f", load {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
    return f"commit {commit()}, {platform.platform()}, {os.cpu_count()} cores{load}, Python {platform.python_version()}"


def note_time(page: Path, command: str, seconds: float) -> None:
    """Write the commit and the minutes that a command took into the last cell of its row."""
    took = f"{seconds:.0f} s" if seconds < SHORT_S else f"{seconds / 60:.0f} min"
    lines = page.read_text(encoding="utf-8").split("\n")
    for i, line in enumerate(lines):
        if line.startswith(f"| `{command}`"):
            lines[i] = f"{line.rsplit('|', 2)[0]}| {took}, {commit()} |"
    page.write_text("\n".join(lines), encoding="utf-8")


def main() -> None:
    """Run the commands and print how long each took."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("words", nargs="*")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", dest="values")
    parser.add_argument("--list", action="store_true", help="print the commands and run none")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "benchmarks")
    parser.add_argument("--times", action="store_true", help="write times and commit into docs/benchmarks.md")
    options = parser.parse_args()
    ready, lacking = commands(options.words, dict(value.split("=", 1) for value in options.values))
    failed = 0
    for text, command in ready.items():
        name = "-".join(re.sub(r"[^A-Za-z0-9]+", "-", Path(part).stem).strip("-") for part in command[1:])
        if options.list:
            print(shlex.join(["python", *command[1:]]))
            continue
        options.out.mkdir(parents=True, exist_ok=True)
        begin, head = time.monotonic(), origin()
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        seconds = time.monotonic() - begin
        head = f"$ {shlex.join(['python', *command[1:]])}\n{head}\n{seconds:.0f} s, exit code {done.returncode}\n\n"
        (options.out / f"{name[:100]}.txt").write_text(head + done.stdout + done.stderr, encoding="utf-8")
        failed += done.returncode != 0
        if options.times and not done.returncode:
            note_time(PAGE, text, seconds)
        print(f"{seconds:8.0f} s  {'failed' if done.returncode else 'done  '}  {name}", flush=True)
    for text in lacking:
        print(f"skipped, lacks a value (--set): {text}")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
