"""Commands from parameters to a sound file: simulate and render."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..errors import ParameterError
from ..felt import ALL_PARAMETERS, make_hammer
from ..io.files import check_target, encode_wav, limit_peak, printable, replace_file
from ..parameters import Geometry, String, check
from ..transducer import ON_STRING, QUANTITIES, TRANSDUCERS
from .options import PICKUP, RATE, Force, Seconds, Seed, Sound, choice, integer, real, text

if TYPE_CHECKING:
    from ..literature import Preset
    from ..model.note import Note


def simulate(
    out: Sound,
    preset: Annotated[
        str | None, text("NAME", "A published string and hammer, such as bensa-final. An unknown name lists all.")
    ] = None,
    note: Annotated[
        str | None, text("NOTE", "Instead of --preset: typical string and hammer of a key, such as C4.", "--typical")
    ] = None,
    change: Annotated[
        list[str], text("NAME=NUMBER", "A parameter to change; may be given several times.", "--set")
    ] = [],  # noqa: B006
    velocity: Annotated[float | None, real("M/S", "Hammer velocity in m/s.", default="that of the preset")] = None,
    seconds: Seconds = 3.0,
    rate: Annotated[int, RATE] = 44_100,
    quantity: Annotated[str, choice("QUANTITY", "Quantity of the pickup", QUANTITIES)] = "bridge-force",
    strike: Annotated[
        float | None, real("M", "Strike position, m from the agraffe.", default="that of the preset")
    ] = None,
    pickup: Annotated[float | None, real("M", PICKUP, default="that of the preset")] = None,
    scale: Annotated[
        float | None,
        real(
            "VALUE",
            "Value at digital full scale, in the unit of --quantity: m/s, m or N.",
            default="the peak is at -1 dBFS",
        ),
    ] = None,
    noise_db: Annotated[
        float | None, real("DB", "White noise, dB below the rms of the first second.", "--noise", default="none")
    ] = None,
    seed: Seed = 0,
    setup_out: Annotated[
        Path | None, text("SETUP.TOML", "Also write the setup for a calibrated fit of the sound.")
    ] = None,
    force: Force = False,
) -> None:
    """Simulate a published or typical string and write its sound, optionally with a setup for a fit."""
    check_target(out, force, ".wav")
    if setup_out is not None:
        check_target(setup_out, force)
        if setup_out.resolve() == out.resolve():
            raise ParameterError(f"--setup-out {printable(setup_out)} is also --out; give another name")
    from ..model.note import check_render
    from ..report.summary import contact_text
    from ..synthetic import synthetic_recording

    check_render(velocity, seconds, rate)
    string, hammer, geometry = _apply_changes(_load_preset(preset, note), change, velocity)
    geometry = _apply_positions(geometry, quantity, strike, pickup)
    sizes = {"rate": rate, "seconds": seconds, "quantity": quantity, "scale": scale, "noise_db": noise_db, "seed": seed}
    name = out.name.encode(errors="backslashreplace").decode()  # the setup is UTF-8
    recording = synthetic_recording(string, hammer, geometry, **sizes, name=name)
    replace_file(out, encode_wav(recording.samples, rate))
    if setup_out is not None:
        replace_file(setup_out, recording.setup_text.encode())
    largest = float(recording.simulation.pulse.force.max())
    typer.echo(
        f"{printable(out)}: {seconds:g} s, largest force {largest:.3g} N, {contact_text(recording.simulation)}, "
        f"full scale {recording.scale:.4g} {TRANSDUCERS[quantity].unit}"
    )


def _load_preset(preset: str | None, note: str | None) -> Preset:
    """Return the preset or the typical note. Exactly one of them must be given."""
    from .. import literature

    if preset is not None and note is None:
        return literature.preset(preset)
    if note is not None and preset is None:
        return literature.typical(note)
    raise typer.BadParameter(f"give --preset NAME or --typical NOTE{'' if preset is None else ', not both'}")


def _apply_changes(preset: Preset, change: list[str], velocity: float | None) -> tuple[String, Any, Geometry]:
    """String, hammer and geometry with the values of --set and --velocity."""
    changed = _assignments(change)
    if velocity is not None and "v_H0" in changed:
        raise ParameterError(f"velocity={velocity} and --set v_H0={changed['v_H0']} are both given; remove one of them")
    values = preset.string._asdict() | preset.hammer._asdict() | changed
    if velocity is not None:
        values["v_H0"] = velocity
    check({name: value for name, value in values.items() if (name, value) != ("mu", 0.0)}, "--set", ALL_PARAMETERS)
    return (
        preset.string._replace(**{k: values[k] for k in preset.string._fields}),
        make_hammer(values, "--set"),
        preset.geometry,
    )


def _apply_positions(geometry: Geometry, quantity: str, strike: float | None, pickup: float | None) -> Geometry:
    """Replace strike and pickup position in a geometry."""
    if pickup is not None and quantity not in ON_STRING:
        raise ParameterError(
            f"pickup={pickup:g} m: a {quantity} pickup has no position; choose {' or '.join(ON_STRING)}"
        )
    given = {"strike_position": strike, "pickup": pickup}
    return geometry._replace(**{name: value for name, value in given.items() if value is not None})


def _assignments(change: list[str]) -> dict[str, float]:
    values = {}
    for given in change:
        name, _, value = (part.strip() for part in given.partition("="))
        if name in values:
            raise ParameterError(f"--set {given!r}: {name} is set twice; remove one of them")
        try:
            values[name] = float(value)
        except ValueError:
            raise ParameterError(f"--set {given!r} must be NAME=NUMBER, such as c=304.1") from None
    return values


def render(
    fit_json: Annotated[Path, typer.Argument(metavar="FIT.JSON", help="A fit.json.")],
    out: Sound,
    velocity: Annotated[float | None, real("M/S", "Hammer velocity in m/s; required for a struck string.")] = None,
    position: Annotated[
        float | None, real("M", "Plucking position, m from the nearer end.", default="as fitted")
    ] = None,
    seconds: Seconds = 6.0,
    rate: Annotated[int | None, integer("HZ", "Sample rate in Hz.", default="that of the recordings")] = None,
    force: Force = False,
) -> None:
    """Synthesise a fitted note at any velocity or plucking position, with its gain and output path."""
    check_target(out, force, ".wav")
    from ..model.note import check_render
    from ..report.summary import contact_text
    from ..schema.notes import load_note

    check_render(velocity, seconds, 44_100 if rate is None else rate)
    note, own_rate = load_note(fit_json)
    rate = own_rate if rate is None else rate
    played, stroke = _with_stroke(note, velocity, position)
    strike = played.strike(rate)
    samples, gain = limit_peak(
        played.render_channels(strike, rate, round(seconds * rate), round(played.pre_onset_s * rate))
    )
    replace_file(out, encode_wav(samples[0] if len(samples) == 1 else samples, rate))
    scaled = f", multiplied by {gain:.3g} to stay below full scale" if gain < 1 else ""
    contact = f", {contact_text(strike)}" if strike.contacts else ""
    typer.echo(f"{printable(out)}: {seconds:g} s at {stroke}{contact}{scaled}")


def _with_stroke(note: Note, velocity: float | None, position: float | None) -> tuple[Note, str]:
    """Return the note with the stroke of the command line, and the stroke in words."""
    from ..felt import law_of
    from ..model.simulate import check_geometry

    stroke = law_of(note.hammer).stroke
    options = {"v_H0": ("--velocity", velocity), "x0": ("--position", position)}
    option, value = options.pop(stroke.name)
    for other, given in options.values():
        if given is not None:
            raise ParameterError(f"{other} {given:g}: this fit has no such parameter; use {option}")
    if value is None and stroke.name == "v_H0":
        raise ParameterError("a fitted hammer needs --velocity, in m/s")
    played = note if value is None else note.with_stroke(value)
    check_geometry(played.geometry, played.quantity)
    return (
        played,
        f"{stroke.name} = {played.stroke_value:.3g} {stroke.unit}" if velocity is None else f"{velocity:g} m/s",
    )
