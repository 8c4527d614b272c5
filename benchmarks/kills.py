"""What is left of batch, fit --force, export and page that were killed, and whether the next run finishes the work.

    python benchmarks/kills.py                 50 kills, full and read-only disks, two processes on one folder
    python benchmarks/kills.py --kills 8

Every command runs once to its end; the same input gives the same bytes. Then it runs again, with --force where it
takes that, and SIGKILL ends it and all its children at a moment drawn by --seed, evenly over the time that its fastest
run took. A run that ends before its moment is no kill: another takes its place, with moments over that run's time.
After each kill every file under a final name must hold what the whole run wrote there, old or new; names that begin
with a dot are what a kill may leave behind, and are counted. A batch starts from nothing, is killed, and goes on: what
was done before must still be there, unchanged, and its end must be that of the whole run. A disk is made full by a
limit on the size of a file, which the system reports as it does a disk without room.

Exits with 1 if anything was lost or half-written.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from made import make_notes

PROGRAM = (sys.executable, "-m", "pianofit")
# Entries of a JSON file that describe the run and not the result: where it lay, when, how long.
OF_THE_RUN = ("seconds", "when", "host", "started", "ended", "time", "pid")
# In front of a command: root without its right to write anywhere.
BOUND = ("setpriv", "--bounding-set", "-dac_override,-dac_read_search", "--inh-caps", "-dac_override,-dac_read_search")


# Of any file on a full disk, bytes: less than every command's largest file, more than a batch's record of a failure.
ROOM = 2**13
# Runs per kill at the most; by the second most moments lie within the fastest run.
MOST_TRIES = 4


class Work(NamedTuple):
    """A command and what it writes."""

    name: str
    arguments: list[str]
    out: Path
    fresh: bool = False  # whether every kill begins from nothing, and is followed by a run to the end


def run(arguments: list[str], before: tuple[str, ...] = ()) -> subprocess.CompletedProcess:
    """A command to its end."""
    return subprocess.run([*before, *PROGRAM, *arguments], capture_output=True, text=True, check=False)


def contents(out: Path) -> dict[str, bytes]:
    """All files under final names, by their names."""
    if out.is_file():
        return {out.name: out.read_bytes()}
    files = [p for p in out.rglob("*") if p.is_file() and not any(x.startswith(".") for x in p.relative_to(out).parts)]
    return {str(p.relative_to(out)): settled(p.name, p.read_bytes()) for p in files}


def settled(name: str, data: bytes) -> bytes:
    """A file without the entries about the run; a JSON file that is not whole raises."""
    if not name.endswith(".json"):
        return data

    def bare(value):
        if isinstance(value, dict):
            return {key: bare(x) for key, x in value.items() if key not in OF_THE_RUN}
        return [bare(x) for x in value] if isinstance(value, list) else value

    return json.dumps(bare(json.loads(data))).encode()


def leftovers(out: Path) -> int:
    """How many files under names that begin with a dot and end in .tmp there are."""
    return len([*(out if out.is_dir() else out.parent).rglob(".*.tmp")])


def killed(work: Work, after: float) -> float | None:
    """None where the command still ran when it was killed, with its children, `after` s; else how long it took."""
    began = time.perf_counter()
    process = subprocess.Popen(
        [*PROGRAM, *work.arguments], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    )
    try:
        process.wait(after)
        return time.perf_counter() - began
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        return None


def wrong(found: dict[str, bytes], whole: dict[str, bytes], *, all_there: bool) -> list[str]:
    """Names whose content is neither absent nor that of the whole run."""
    other = [f"{name}: half-written or of no run" for name in found if found[name] != whole.get(name)]
    return other + ([f"{name}: lost" for name in whole if name not in found] if all_there else [])


def after_a_kill(work: Work, whole: dict[str, bytes]) -> list[str]:
    """What is wrong with what a kill left, and with what the next run of a batch makes of it."""
    before = contents(work.out)
    if not work.fresh:
        return wrong(before, whole, all_there=True)
    faults = wrong(fits_of(before), whole, all_there=False)
    again = run(work.arguments)
    faults += [again.stderr.strip()] if again.returncode else []
    return faults + wrong(fits_of(contents(work.out)), fits_of(whole), all_there=True)


def fits_of(files: dict[str, bytes]) -> dict[str, bytes]:
    """Those that are a batch's results; what workers are at lies under its ledger, and goes with the next run."""
    return {name: data for name, data in files.items() if name.startswith("keys/") and name.endswith("fit.json")}


def tried(work: Work, kills: int, draw: np.random.Generator) -> tuple[list[str], str]:
    """What went wrong with a command that was killed so many times, and a line of figures."""
    if work.fresh:
        clear(work.out)
    began = time.perf_counter()
    done = run(work.arguments)
    if done.returncode:
        return [f"{work.name} does not run: {done.stderr.strip()}"], ""
    took, whole = time.perf_counter() - began, contents(work.out)
    faults, hit, left, fastest, tries = [], 0, 0, took, 0
    while hit < kills and tries < MOST_TRIES * kills:
        if work.fresh:
            clear(work.out)
        tries += 1
        ended = killed(work, float(draw.uniform(0.1, fastest)))
        if ended is not None:
            fastest = min(fastest, ended)
            continue
        hit, left = hit + 1, max(left, leftovers(work.out))
        try:
            faults += after_a_kill(work, whole)
        except ValueError as error:
            faults.append(f"{work.name}: a JSON file that is not whole ({error})")
    if hit < kills:
        faults.append(f"{work.name}: only {hit} of {kills} kills came before the end, in {tries} runs")
    last = run(work.arguments)
    faults += [last.stderr.strip()] if last.returncode else []
    after = leftovers(work.out)
    return (
        faults,
        f"{took:6.1f} s, then {fastest:.1f}; {hit} of {tries} runs killed before their end, {left} temporary files "
        f"left, {after} after the next run",
    )


def clear(out: Path) -> None:
    """Remove an output."""
    import shutil

    shutil.rmtree(out, ignore_errors=True)


def read_only(folder: Path, commands: list[tuple[str, Callable[[Path], list[str]]]]) -> list[str]:
    """Each command into a folder that may not be written to: one line, and nothing written."""
    faults, before = [], () if os.geteuid() else BOUND
    locked = folder / "locked"
    locked.mkdir()
    locked.chmod(0o555)
    for name, arguments in commands:
        done = run(arguments(locked / "out"), before)
        lines = done.stderr.strip().splitlines()
        if done.returncode != 1 or len(lines) != 1 or "locked" not in lines[0]:
            faults.append(f"{name} into a read-only folder: {done.returncode}, {done.stderr.strip()[-300:]}")
        if any(locked.iterdir()):
            faults.append(f"{name} wrote into a read-only folder")
    return faults


def full_disk(work: Work) -> list[str]:
    """The command where no file may grow beyond ROOM: it fails in one line, and no result is lost or half-written."""
    if work.fresh:
        clear(work.out)
    of = fits_of if work.fresh else dict
    before = of(contents(work.out))
    done = run(work.arguments, ("prlimit", f"--fsize={ROOM}"))
    lines = done.stderr.strip().splitlines()
    faults = []
    if done.returncode != 1 or len(lines) != 1 or work.out.name not in lines[0] or "make room" not in lines[0]:
        faults = [f"{work.name} on a full disk: {done.returncode}, {done.stderr.strip()[-300:]}"]
    return faults + wrong(of(contents(work.out)), before, all_there=True)


def together(work: Work) -> list[str]:
    """Two processes at once on one output: both end as they should, and what is there is whole."""
    whole = contents(work.out)
    if work.fresh:
        clear(work.out)
    pair = [
        subprocess.Popen([*PROGRAM, *work.arguments], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        for _ in range(2)
    ]
    said = [process.communicate()[1].strip() for process in pair]
    codes = [process.returncode for process in pair]
    faults = [f"{work.name} twice at once: {code}, {text[-300:]}" for code, text in zip(codes, said, strict=True)
              if code and (code != 1 or len(text.splitlines()) != 1)]  # fmt: skip
    if all(codes):
        faults.append(f"{work.name} twice at once: neither finished: {said}")
    of = fits_of if work.fresh else dict
    return faults + wrong(of(contents(work.out)), of(whole), all_there=True)


def works(place: Path) -> list[Work]:
    """The commands, with what they read made."""
    samples, fits, instrument = (place / name for name in ("samples", "fit", "instrument"))
    samples.mkdir()
    files = make_notes(place, seconds=2.0)
    for name, file in (("one", files[1]), ("two", files[3])):
        (samples / f"{name}-C2.wav").write_bytes(file.read_bytes())
    fit = ["fit", str(files[0]), "--note", "C2", "--out", str(fits), "--force"]
    for arguments in (fit, ["instrument", str(fits / "fit.json"), "--out", str(instrument)]):
        done = run(arguments)
        if done.returncode:
            raise SystemExit(done.stderr)
    built = str(instrument / "instrument.json")
    out = {name: place / name for name in ("batch", "export", "page.html")}
    return [
        Work("page", ["page", built, "--out", str(out["page.html"]), "--force"], out["page.html"]),
        Work("export", ["export", built, "--keys", "C3,E3", "--velocity-layers", "2", "--seconds", "2", "--out",
             str(out["export"]), "--force"], out["export"]),
        Work("fit --force", fit, fits),
        Work("batch", ["batch", str(samples), "--pattern", "{instrument}-{note}.wav", "--out", str(out["batch"])],
             out["batch"], fresh=True),
    ]  # fmt: skip


def main() -> None:
    """Kill, look, and say what was found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=50, help="over all commands")
    parser.add_argument("--commands", default="page,export,fit,batch", help="separated by commas")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    draw, faults = np.random.default_rng(options.seed), list[str]()
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        place.chmod(0o755)
        every = [work for work in works(place) if work.name.split()[0] in options.commands.split(",")]
        shares = [options.kills // len(every) + (n < options.kills % len(every)) for n in range(len(every))]
        for work, kills in zip(every, shares, strict=True):
            found, figures = tried(work, kills, draw)
            twice, full = together(work), full_disk(work)
            print(f"{work.name:12} {figures}; {len(found)} faults, twice at once: {len(twice)}, full disk: {len(full)}")
            faults += found + twice + full
            for fault in (*found, *twice, *full):
                print(f"  {fault}", flush=True)
        locked = [
            (work.name, lambda out, w=work: [f"{out}{w.out.suffix}" if x == str(w.out) else x for x in w.arguments])
            for work in every
        ]
        found = read_only(place, locked)
        print(f"read-only folders: {len(every)} commands, {len(found)} faults")
    for fault in found:
        print(f"  {fault}")
    sys.exit(1 if faults or found else 0)


if __name__ == "__main__":
    main()
