"""Command line: errors, interrupts, round trips and reproducibility."""

from __future__ import annotations

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import mido
import numpy as np
import pytest
import soundfile
import typer
from bad_inputs import BAD_INPUTS, BadInput, encoded, note
from instrument_cases import true_instrument
from report_cases import example_fit
from scipy.signal import zoom_fft

from pianofit import ExportOptions, NoteOptions, PlayOptions
from pianofit.cli import app, main
from pianofit.errors import OutputError
from pianofit.instrument import write_instrument
from pianofit.io.files import PEAK_LIMIT, output_folder, replace_file
from pianofit.io.table_output import write_csv
from pianofit.literature import PRESETS, preset
from pianofit.mend import MendOptions
from pianofit.report.summary import _recording_line
from pianofit.schema.decode import encode_json

PROGRAM = (sys.executable, "-m", "pianofit")
AS_PROCESSES = ("audio-truncated", "fit-velocity-word", "demo-out-not-empty")


def state(folder: Path) -> dict[str, tuple[float, int]]:
    """Content of a folder with modification times and sizes."""
    found = sorted(folder.rglob("*"))
    return {str(p): (p.lstat().st_mtime, p.lstat().st_size if not p.is_dir() else 0) for p in found}


def check_refusal(bad: BadInput, code: int, output: str, errors: str) -> None:
    assert code == bad.code
    assert errors.endswith("\n")
    assert errors[:-1].isprintable(), "one line"
    assert errors.startswith("pianofit: ")
    assert bad.is_explained_by(errors)
    assert not output


@pytest.fixture
def run(capsys):
    """Run a command line in this process, check the exit code and return the output."""

    def run(*arguments: object, code: int = 0) -> str:
        found = main([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        assert found == code, captured.err
        return captured.out

    return run


# --- what cannot be done ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bad", BAD_INPUTS, ids=lambda bad: bad.id)
def test_a_bad_input_is_one_line_and_writes_nothing(bad, tmp_path, capsys):
    bad.build(tmp_path)
    before = state(tmp_path)
    code = main(bad.arguments(tmp_path))
    captured = capsys.readouterr()
    check_refusal(bad, code, captured.out, captured.err)
    assert state(tmp_path) == before


@pytest.mark.parametrize("bad", [bad for bad in BAD_INPUTS if bad.id in AS_PROCESSES], ids=lambda bad: bad.id)
def test_a_bad_input_in_a_process_of_its_own(bad, tmp_path):
    bad.build(tmp_path)
    before = state(tmp_path)
    done = subprocess.run([*PROGRAM, *bad.arguments(tmp_path)], capture_output=True, text=True, check=False)
    check_refusal(bad, done.returncode, done.stdout, done.stderr)
    assert state(tmp_path) == before


def test_a_number_has_no_unit_where_its_range_has_none(tmp_path, capsys):
    assert main(["simulate", "--preset", "bensa-final", "--set", "p=9", "--out", str(tmp_path / "a.wav")]) == 1
    assert capsys.readouterr().err.endswith("p=9.0 must be a number from 1 to 5\n")


@pytest.mark.parametrize(
    ("command", "option"),
    [
        ("dataset --out @/out --count 0", "--count 0 must be from 1 to 10,000,000"),
        ("dataset --out @/out --modal-response", "--modal-response needs --around,"),
        ("dataset --out @/out --noise 70-40", "--noise 70.0-40.0 must"),
        ("play @ @/a.mid --out @/a.wav --pedal-range 64-24", "--pedal-range 64-24 must"),
        ("play @ @/a.mid --out @/a.wav --gain 99", "--gain 99.0 dB must"),
        ("export @ --out @/a.dsp --format faust --no-fill", "--format faust has no samples; leave out --no-fill"),
        ("mend @ --fits @ --dry-run --even-levels 2", "--even-levels 2.0 must"),
        ("mend @ --fits @ --dry-run --keys C2..C6", "--keys C2..C6 must"),
        ("simulate --preset 'my piano' --out @/a.wav", "--preset 'my piano' is unknown"),
        ("fit @/note=1.wav --out @/out", "/note=1.wav: no such file"),
        ("fit @/a.wav --out @/out --evaluations 600", "--evaluations 600 needs an annealing: use --recipe paper"),
        ("tuning @ --octave 3:1", "--octave 3:1 must be 2:1, 4:2 or 6:3; see pianofit tuning --help"),
    ],
)
def test_an_error_names_the_option_as_it_was_typed(command, option, tmp_path, capsys):
    write_instrument(tmp_path / "instrument.json", true_instrument(range(60, 61)))
    mido.MidiFile(tracks=[mido.MidiTrack([mido.Message("note_on", note=60)])]).save(tmp_path / "a.mid")
    assert main(shlex.split(command.replace("@", str(tmp_path)))) in (1, 2)
    assert option in capsys.readouterr().err


def test_the_corpus_is_large_and_meets_every_command():
    assert len(BAD_INPUTS) >= 200
    assert {"fit", "analyse", "simulate", "render", "demo", "listen"} <= {bad.args[0] for bad in BAD_INPUTS}
    assert len(AS_PROCESSES) == len([bad for bad in BAD_INPUTS if bad.id in AS_PROCESSES])


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
@pytest.mark.parametrize("command", ["fit {}/note.wav --note A4 --out {}/locked", "demo --out {}/locked/demo"])
def test_a_folder_that_is_not_ours_is_refused(command, tmp_path, capsys):
    (tmp_path / "note.wav").write_bytes(encoded(note()))
    (tmp_path / "locked").mkdir(mode=0o555)
    assert main(command.replace("{}", str(tmp_path)).split()) == 1
    assert "locked" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["status {}", "page {}", "batch {}/a --out {}", "play {}/a.json b.mid --out c.wav"])
def test_a_name_that_is_too_long_is_one_line(command, tmp_path, capsys):
    assert main(command.replace("{}", str(tmp_path / ("y" * 256))).split()) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "yyy" in line


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_is_one_line_and_leaves_nothing_behind(tmp_path, capsys, number):
    out = tmp_path / "runs" / "out"
    # Send the signal after the fit has begun. The progress bar cannot show that, because it needs a terminal.
    begin = (
        "import sys, pianofit.fitting as fitting, pianofit.cli as cli\n"
        "real = fitting.fit\n"
        "def begun(*args, **kwargs):\n    print('begun', flush=True)\n    return real(*args, **kwargs)\n"
        "fitting.fit = begun\n"
        "sys.exit(cli.main())"
    )
    (tmp_path / "note.wav").write_bytes(encoded(note(146.8, 2.0)))
    command = [sys.executable, "-c", begin, "fit", str(tmp_path / "note.wav"), "--note", "D3", "--out", str(out)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "begun\n"
        assert out.is_dir()
        time.sleep(0.3)
        # Another command does not write to the same folder.
        assert main(["fit", str(tmp_path / "note.wav"), "--note", "D3", "--out", str(out), "--force"]) == 1
        process.send_signal(number)
        output, errors = process.communicate(timeout=180)
    assert process.returncode == 128 + number
    assert "another command is writing" in capsys.readouterr().err
    assert errors == "pianofit: interrupted; nothing more is written\n"
    assert output == ""
    assert [p.name for p in tmp_path.iterdir()] == ["note.wav"]


def test_an_interrupt_during_imports_is_one_line():
    """The import of a package sends the signal."""
    program = (
        "import os, signal, sys, pianofit.__main__ as entry\n"
        "class Finder:\n    def find_spec(self, name, *_):\n"
        "        if name == 'typer':\n            os.kill(os.getpid(), signal.SIGINT)\n"
        "sys.meta_path.insert(0, Finder())\nsys.argv[1:] = ['--version']\nentry.run()"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr == "pianofit: interrupted; nothing more is written\n"


@pytest.mark.parametrize("failure", [OutputError("the disk is full"), KeyboardInterrupt()])
def test_a_failed_run_removes_its_own_files_from_a_new_folder(tmp_path, failure):
    out = tmp_path / "runs" / "out"

    def fail(force: bool = False) -> None:
        with suppress(type(failure)), output_folder(out, force) as folder:
            (folder / "sub").mkdir(exist_ok=True)
            replace_file(folder / "sub" / ("n" * 255), b"")  # names may be as long as the file system allows
            if force:
                (folder / "theirs").touch()
            raise failure

    fail()
    assert not [*tmp_path.iterdir()]
    out.mkdir(parents=True)
    fail(force=True)
    assert [path.name for path in out.iterdir()] == ["theirs"]
    fail(force=True)  # the folder was not empty
    assert (out / "sub").is_dir()


def test_names_that_utf8_does_not_encode_are_escaped(tmp_path):
    assert json.loads(encode_json({"file": "n\udcff\n.wav"})) == {"file": "n\\udcff\n.wav"}
    write_csv(tmp_path / "t.csv", ["file"], [["n\udcff.wav"]])
    assert (tmp_path / "t.csv").read_text() == "file\nn\\udcff.wav\n"


def test_a_terminal_that_cannot_show_a_name_shows_a_question_mark(tmp_path):
    out = tmp_path / "a→b\nc.wav"
    command = ["simulate", "--preset", "bensa-final", "--seconds", "0.1", "--out", str(out)]
    done = subprocess.run([*PROGRAM, *command], capture_output=True, env=os.environ | {"PYTHONIOENCODING": "cp1252"})
    assert done.returncode == 0, done.stderr
    assert b"a?b\\nc.wav: 0.1 s" in done.stdout
    assert done.stdout.count(b"\n") == 1
    assert out.is_file()


def test_a_reader_that_has_had_enough_is_no_error(tmp_path):
    (tmp_path / "note.wav").write_bytes(encoded(note()))
    line = f'"{sys.executable}" -m pianofit analyse "{tmp_path}/note.wav" --note A4'
    done = subprocess.run(
        ["bash", "-c", f"set -o pipefail; {line} | true"], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="/dev/full does not exist")
@pytest.mark.parametrize("command", ["analyse note.wav --note A4", "analyse note.wav --note A4 --json", "fit --help"])
def test_an_output_that_is_full_is_one_line(command, tmp_path):
    (tmp_path / "note.wav").write_bytes(encoded(note()))
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [*PROGRAM, *command.split()], stdout=full, stderr=subprocess.PIPE, text=True, check=False, cwd=tmp_path
        )
    assert done.returncode == 1
    assert done.stderr == "pianofit: standard output cannot be written (No space left on device); send it elsewhere\n"


@pytest.mark.skipif(sys.platform == "win32", reason="needs a POSIX shell")
@pytest.mark.parametrize(
    ("streams", "code", "lines"),
    [(">&-", 1, 1), (">&- 2>&-", 1, 0), ("2>&-", 0, 0), ("<&-", 0, 0), ("| head -0", 0, 0)],
)
def test_a_closed_stream_is_one_line_or_none(streams, code, lines, tmp_path):
    """No output file takes the number of the closed stream, so the output is complete."""
    command = f"simulate --preset bensa-final --seconds 0.1 --out {shlex.quote(str(tmp_path / 'a.wav'))}"
    said = (
        f"{{ {shlex.join(PROGRAM)} {command}; echo $? >&3; }}"
        if "|" in streams
        else shlex.join(PROGRAM) + f" {command}"
    )
    script = f"{{ {said} {streams}; }} 3>&1" if "|" in streams else f"{said} {streams}"
    done = subprocess.run(["/bin/sh", "-c", script], capture_output=True, text=True, check=False)
    assert (int(done.stdout) if "|" in streams else done.returncode) == code
    assert done.stderr.count("\n") == lines
    assert (tmp_path / "a.wav").exists() == (code == 0)
    if code == 0:
        assert soundfile.info(tmp_path / "a.wav").frames == 4410


# --- what can be done -------------------------------------------------------------------------------------------------


def test_analyse_prints_a_table_and_data(tmp_path, run):
    (tmp_path / "note.wav").write_bytes(encoded(note()))
    data = json.loads(run("analyse", tmp_path / "note.wav", "--note", "A4", "--json"))
    text = run("analyse", tmp_path / "note.wav", "--f0", "440")
    assert "the pitch" not in text, "a warning says how it moves, where it does"
    assert 1200 * abs(np.log2(data["f0"] / 440)) < 0.1
    assert data["B"] == pytest.approx(3e-4, rel=0.02)
    laws = {line.split()[0]: line for line in text.splitlines() if line[:3].strip() in ("f0", "B", "b1", "d2")}
    for name in ("f0", "B", "b1", "d2"):
        low, high = (float(end) for end in laws[name].split("[")[1].split("]")[0].split(", "))
        assert low < data[name] < high
        assert (high - low) / 2 == pytest.approx(1.96 * data[f"{name}_error"], rel=0.1)
    table = [line.split() for line in text.splitlines() if line and line.split()[0].isdigit()]
    # None in the data, and "-" in the table, is a part of the decay that is not visible.
    partials = {name: np.array(column, float) for name, column in data["partials"].items()}
    assert [int(row[0]) for row in table] == data["partials"]["number"]
    whole = {
        name: np.hypot(partials[f"{name}_error"], partials[f"{name}_systematic"]) for name in ("frequency", "level")
    }
    early = np.hypot(partials["decay_error"], partials["decay_systematic"]) / partials["decay"]
    late = partials["late_decay_error"] / partials["late_decay"]
    whole |= {"early_t60": partials["early_t60"] * early, "late_t60": partials["late_t60"] * late}
    for column, name in ((1, "frequency"), (4, "early_t60"), (6, "late_t60"), (8, "level")):
        value, error = (
            np.array([float("nan" if row[i] == "-" else row[i]) for row in table]) for i in (column, column + 1)
        )
        np.testing.assert_allclose(error, whole[name], rtol=0.06)
        assert (np.isnan(value) | (np.abs(value - partials[name]) <= 0.06 * whole[name])).all()


def test_analyse_says_what_was_done_to_the_recording(tmp_path, run):
    (tmp_path / "note.wav").write_bytes(encoded(0.5 * note() + 0.03))
    (warning,) = json.loads(run("analyse", tmp_path / "note.wav", "--note", "A4", "--json"))["warnings"]
    assert warning == "an offset of 0.03 of full scale was removed"
    assert run("analyse", tmp_path / "note.wav", "--note", "A4").endswith(f"{warning}\n")


@pytest.mark.parametrize("name", ["bensa-final", "chabassier-C2"])
def test_simulate_writes_the_preset_at_its_pitch(name, tmp_path, run):
    assert name in PRESETS
    rate = 32_000
    run("simulate", "--preset", name, "--seconds", 4, "--rate", rate, "--out", tmp_path / "a.wav")
    samples, found = soundfile.read(tmp_path / "a.wav")
    assert (found, len(samples)) == (rate, 4 * rate)
    assert np.abs(samples).max() == pytest.approx(PEAK_LIMIT, rel=1e-6)
    string, geometry = preset(name).string, preset(name).geometry
    B = (string.kappa * np.pi / (string.c * geometry.length)) ** 2
    first = string.c / (2 * geometry.length) * np.sqrt(1 + B)
    # Peak of the first partial, on a grid of 0.06 cents.
    near, steps = [0.8 * first, 1.2 * first], 12_000
    spectrum = np.abs(zoom_fft(samples * np.hanning(len(samples)), near, steps, fs=rate))
    peak = np.linspace(*near, steps, endpoint=False)[np.argmax(spectrum)]
    assert 1200 * abs(np.log2(peak / first)) < 1


def test_simulate_changes_what_it_is_told_to(tmp_path, run):
    common = ("simulate", "--preset", "bensa-final", "--seconds", 0.5, "--quantity", "velocity", "--out")
    run(*common, tmp_path / "a.wav", "--set", "c=400", "--velocity", "2")
    run(*common, tmp_path / "b.wav", "--set", "c=400", "--set", "v_H0=2")
    run(*common, tmp_path / "c.wav")
    a, b, c = ((tmp_path / f"{name}.wav").read_bytes() for name in "abc")
    assert a == b
    assert a != c


def test_force_replaces_a_sound(tmp_path, run):
    (tmp_path / "a.wav").write_text("old")
    run("simulate", "--preset", "bensa-final", "--seconds", 0.1, "--out", tmp_path / "a.wav", "--force")
    assert soundfile.info(tmp_path / "a.wav").frames == 4410
    assert [p.name for p in tmp_path.iterdir()] == ["a.wav"]


# --- help -------------------------------------------------------------------------------------------------------------


def helped(arguments: str) -> str:
    """Return a help text for a terminal of 80 columns."""
    done = subprocess.run(
        [*PROGRAM, *arguments.split()], capture_output=True, text=True, check=True, env=os.environ | {"COLUMNS": "80"}
    )
    return done.stdout


@pytest.fixture(scope="module")
def commands() -> dict:
    return typer.main.get_command(app).commands


def test_the_help_of_the_program_names_every_command_and_cuts_nothing(commands):
    text = helped("--help")
    assert text == helped("-h")
    listed = text.partition("--help")[2].partition("One note:")[2]
    assert {line.split()[0] for line in listed.splitlines() if line[2:3].isalpha()} >= {*commands}
    assert all(f"\n{command.rich_help_panel}:\n" in text for command in commands.values())
    assert "..." not in text.replace("COMMAND [ARGS]...", "")
    assert max(map(len, text.splitlines())) <= 80


def test_the_help_of_every_command_has_an_example_that_parses_and_no_types(commands, capsys):
    for name, command in commands.items():
        assert main([name, "-h"]) == 0
        text = capsys.readouterr().out
        example = text.partition("Example:\n")[2].strip()
        assert example.startswith(f"pianofit {name} ")
        command.make_context(name, shlex.split(example)[2:]).close()
        assert not re.search(r"\b(TEXT|PATH|FLOAT|INTEGER|list\[|<path>|TAKE)\b|<path>|\{[A-Z]", text), text
        assert all(option.help or option.hidden for option in command.params), name


def test_the_options_of_all_commands_have_one_style(commands):
    """A metavar is in capitals, and a default is not in the prose of a help text."""
    for name, command in commands.items():
        for option in command.params:
            metavar = option.metavar or ""
            assert re.fullmatch(r"[A-Z0-9_./=|-]*(\.\.\.)?", metavar), f"{name} {metavar}"
            assert bool(metavar) != bool(getattr(option, "is_flag", False)), f"{name} {option.name}"
            assert not re.search(r"(?i)\bdefault\b[: ]", option.help), f"{name} {option.name}"


@pytest.mark.parametrize(
    ("command", "options"),
    [
        ("play", PlayOptions()),
        ("export", ExportOptions()._replace(kind=None)),  # pyright: ignore[reportArgumentType]
        ("mend", MendOptions()),
        ("dataset", NoteOptions()),
    ],
)
def test_a_command_has_the_defaults_and_the_names_of_its_function(command, options, commands):
    example = re.findall(r"Example:\n  pianofit \S+ (.*)", commands[command].epilog)[0]
    with commands[command].make_context(command, shlex.split(example)) as context:
        stated = {name for name in context.params if context.get_parameter_source(name).name == "COMMANDLINE"}
        own = options._asdict() if hasattr(options, "_asdict") else vars(options)
        assert own.keys() <= context.params.keys()
        for name in own.keys() - stated:
            assert context.params[name] == pytest.approx(own[name]), name


SHELLS = ("bash", "zsh", "fish")


@pytest.mark.parametrize("shell", SHELLS)
def test_a_shell_completes_every_command_each_on_a_line(shell, commands):
    asked = {"COMP_WORDS": "pianofit ", "COMP_CWORD": "1"} if shell == "bash" else {
        "_TYPER_COMPLETE_ARGS": "pianofit ", "_TYPER_COMPLETE_FISH_ACTION": "get-args"
    }  # fmt: skip
    environment = os.environ | {"_PIANOFIT_COMPLETE": f"complete_{shell}"} | asked
    done = subprocess.run(PROGRAM, capture_output=True, text=True, check=False, env=environment)
    assert not done.returncode
    lines = done.stdout.replace("_arguments '*: :((", "").splitlines()
    assert {re.match(r'"?([\w-]*)', line)[1] for line in lines} == {*commands}  # pyright: ignore[reportOptionalSubscript]


@pytest.mark.parametrize("shell", SHELLS)
def test_the_script_that_teaches_a_shell_is_for_that_shell(shell, monkeypatch, capsys):
    monkeypatch.setattr("shellingham.detect_shell", lambda: (shell, f"/bin/{shell}"))
    with pytest.raises(SystemExit, match=r"^0$"):
        main(["--show-completion"])
    assert f"_PIANOFIT_COMPLETE=complete_{shell}" in capsys.readouterr().out


# --- from a recording to parameters and back to sound -----------------------------------------------------------------


@pytest.fixture(scope="module")
def fitted(tmp_path_factory) -> Path:
    """A folder with note.wav, written by simulate, and out/, the fit of it."""
    folder = tmp_path_factory.mktemp("fitted")
    sound = ("--seconds", "2", "--velocity", "1.5", "--out", str(folder / "note.wav"))
    assert main(["simulate", "--preset", "bensa-final", *sound]) == 0
    common = ("--f0", "152.05", "--velocity", "1.5", "--no-page")
    assert main(["fit", str(folder / "note.wav"), *common, "--out", str(folder / "out")]) == 0
    return folder


def test_fit_writes_what_it_promises(fitted):
    document = json.loads((fitted / "out" / "fit.json").read_text(encoding="utf-8"))
    assert sorted(p.name for p in (fitted / "out").iterdir()) == ["fit.json", "fitted.wav", "initial.wav", "knock.flac"]
    assert document["parameters"]["v_H0"]["status"] == "given"
    assert document["parameters"]["v_H0"]["value"] == 1.5
    assert document["recordings"][0]["file"] == str(fitted / "note.wav")
    string = preset("bensa-final").string
    assert document["derived"]["f0"] == pytest.approx(string.c / 2, rel=1e-4)
    assert document["derived"]["B"] == pytest.approx((string.kappa * np.pi / string.c) ** 2, rel=0.02)
    for name in ("initial.wav", "fitted.wav"):
        info = soundfile.info(fitted / "out" / name)
        assert (info.frames, info.samplerate, info.channels) == (88_200, 44_100, 1)


def test_a_recording_is_named_with_the_channel_that_was_taken():
    (row,) = example_fit().recordings
    row = replace(row, file="far/a.wav", channel="left")
    assert _recording_line(row, "m/s").startswith("a.wav (left) (the reference): 4 m/s")
    assert _recording_line(replace(row, channel="average"), "m/s").startswith("a.wav (the reference): 4 m/s")


def test_render_at_the_fitted_velocity_is_the_fitted_sound(fitted, run):
    velocity = json.loads((fitted / "out" / "fit.json").read_text(encoding="utf-8"))["recordings"][0]["stroke_value"]
    out = fitted / "again.wav"
    run("render", fitted / "out" / "fit.json", "--velocity", repr(velocity), "--seconds", 1.5, "--out", out)
    (again, rate), (first, _) = soundfile.read(out), soundfile.read(fitted / "out" / "fitted.wav")
    assert rate == 44_100
    # Both have the same stroke. Only its time, and a gain that keeps it below full scale, may differ.
    late = int(np.argmax(np.correlate(np.pad(first[:9000], (2000, 0)), again[2000:4000], "valid"))) - 4000
    cut = max(-late, 0)
    same, again = first[late + cut :][: len(again) - cut], again[cut:]
    gain = (same @ again) / (again @ again)
    assert gain >= 1 - 1e-6
    assert np.abs(same - gain * again[: len(same)]).max() < 1e-6 * np.abs(same).max()


def test_render_harder_is_brighter(fitted, run):
    centre = []
    for velocity in (0.5, 4.0):
        out = fitted / f"{velocity}.wav"
        said = run("render", fitted / "out" / "fit.json", "--velocity", velocity, "--seconds", 1, "--out", out)
        assert f"{velocity:g} m/s" in said
        power = np.abs(np.fft.rfft(soundfile.read(out)[0])) ** 2
        centre.append((power * np.arange(len(power))).sum() / power.sum())
    assert centre[1] > 1.2 * centre[0]


def test_predict_says_when_the_key_is_another_and_when_the_velocity_is_at_its_end(fitted, capsys):
    (fitted / "other.wav").write_bytes(encoded(note(440.0, 2.0)))
    assert main(["predict", str(fitted / "out" / "fit.json"), str(fitted / "other.wav")]) == 1
    said = capsys.readouterr().err
    assert "D#3 (152.1 Hz)" in said
    assert "A4 (440.0 Hz)" in said
    assert "--" not in said
    assert main(["predict", str(fitted / "out"), str(fitted / "note.wav")]) == 0  # the folder of a fit
    said = capsys.readouterr().out
    assert "could not be determined" not in said
    assert "took part in the fit" in said
    fast = str(fitted / "fast.wav")  # beyond the searched range
    assert main(["simulate", "--preset", "bensa-final", "--velocity", "20", "--out", fast]) == 0
    assert main(["predict", str(fitted / "out" / "fit.json"), fast]) == 0
    said = capsys.readouterr().out
    assert "could not be determined" in said
    assert "took part in the fit" not in said


def test_the_same_seed_gives_the_same_fit_by_force_beside_what_is_not_its_own(fitted, run):
    folder, first = fitted / "used", fitted / "out"
    folder.mkdir()
    (folder / "notes.txt").write_text("mine")
    (folder / "report.html").write_text("of an earlier fit")
    (folder / "fitted-by-me.wav").write_text("mine too")
    common = ("fit", fitted / "note.wav", "--f0", "152.05", "--velocity", "1.5", "--no-page", "--out", folder)
    run(*common, code=1)
    assert (folder / "report.html").exists()
    printed = run(*common, "--force", "--json")
    assert {p.name for p in folder.iterdir()} == {p.name for p in first.iterdir()} | {"notes.txt", "fitted-by-me.wav"}
    for name in ("fit.json", "initial.wav", "fitted.wav"):
        assert (folder / name).read_bytes() == (first / name).read_bytes()
    assert json.loads(printed) == json.loads((first / "fit.json").read_text(encoding="utf-8"))
    assert (folder / "notes.txt").read_text() == "mine"
