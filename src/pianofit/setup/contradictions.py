"""Contradictions in a setup: values that are valid alone but not together. Each message says what to do."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from ..felt import LAWS
from ..io.files import printable
from ..transducer import ON_STRING, TRANSDUCERS

if TYPE_CHECKING:
    from .values import Setup

# Parameters of any hammer.
HAMMER_NAMES = {name for law in LAWS.values() for name in law.hammer_parameters}


def contradictions(setup: Setup) -> Iterator[str]:
    """Yield a message for each contradiction."""
    for check in (
        _excitation_contradictions,
        _strike_contradictions,
        _pickup_contradictions,
        _value_contradictions,
        _velocity_contradictions,
        _stroke_contradictions,
    ):
        yield from check(setup)


def _excitation_contradictions(setup: Setup) -> Iterator[str]:
    """Values that another excitation does not have."""
    law = setup.law
    if law.has_contact:
        return
    if setup.felt is not None:
        name = setup.felt if isinstance(setup.felt, str) else setup.felt.name
        yield f'[felt] law = "{name}" belongs to a hammer, and a {law.kind} has no felt; remove one of them'
    if setup.pickup_scale is not None:
        yield (
            f"[pickup] scale = {setup.pickup_scale:g} has no effect, because the size of a {law.kind} is unknown; "
            "remove it"
        )
    if setup.prior is not None:
        yield f"[prior] is that of hammers, and does not apply to a {law.kind}; remove it"
    for number, recording in enumerate(setup.recordings, 1):
        if recording.v_H0 is not None:
            yield f"[[recording]] {number} v_H0 = {recording.v_H0:g}: a {law.kind} has no hammer velocity; remove it"


def _strike_contradictions(setup: Setup) -> Iterator[str]:
    """Contact windows that are not on the string."""
    position, length = setup.strike_position, setup.length
    half = (setup.strike_width or 0.0) / 2
    if position is not None and position < half:
        yield (
            f"[strike] width = {2 * half:g} m extends past the agraffe at position = {position:g} m; reduce it or "
            "correct the position"
        )
    if length is not None and (position or half) + half > length:
        yield (
            f"[strike] extends to {(position or half) + half:g} m from the agraffe, past the string length = "
            f"{length:g} m; correct position, width or [string] length"
        )


def _pickup_contradictions(setup: Setup) -> Iterator[str]:
    """A position or a scale that does not fit the quantity."""
    quantity, position, scale = setup.pickup_quantity, setup.pickup_position, setup.pickup_scale
    transducer = TRANSDUCERS[quantity]
    is_searched = transducer.position_is_searched and "pickup" in setup.law.columns
    if transducer.on_string and position is None and not is_searched:
        yield f'[pickup] quantity = "{quantity}" needs a position in m from the agraffe; add it'
    if not transducer.on_string and position is not None:
        yield (
            f'[pickup] position = {position:g} has no meaning with quantity = "{quantity}"; use '
            f"{', '.join(ON_STRING)}, or remove the position"
        )
    if transducer.unknown_path and scale is not None:
        yield (
            f'[pickup] scale = {scale:g} has no meaning with quantity = "{quantity}", because the output path is '
            "unknown; use velocity, displacement or bridge-force, or remove the scale"
        )
    if position is not None and setup.length is not None and position >= setup.length:
        yield (
            f"[pickup] position = {position:g} m is not on the string of length = {setup.length:g} m; correct one "
            "of them"
        )


def _value_contradictions(setup: Setup) -> Iterator[str]:
    """Values both fixed and free, parameters of another felt law, and initial values outside their bounds."""
    law = setup.law
    for name in setup.fixed:
        for table, given in (("initial", setup.initial), ("bounds", setup.bounds)):
            if name in given:
                yield f"{name} is in [fixed] and in [{table}]; remove one of them"
    for name in (*setup.fixed, *setup.initial, *setup.bounds):
        if name in HAMMER_NAMES and name not in law.hammer_parameters:
            allowed = ", ".join(law.parameters)
            has = f"the felt law {law.name}, which has {allowed}" if law.has_contact else f"a {law.kind}"
            yield f"{name} is not a parameter of {has}; remove it"
    for name, (lower, upper) in setup.bounds.items():
        if not lower <= (value := setup.initial.get(name, lower)) <= upper:
            yield f"[initial] {name} = {value:g} is outside its [bounds] {lower:g} to {upper:g}; correct one"


def _velocity_contradictions(setup: Setup) -> Iterator[str]:
    """Recordings with two velocities, and files given twice."""
    lower, upper = setup.bounds.get("v_H0", (0.0, float("inf")))
    files: set[str] = set()
    for number, recording in enumerate(setup.recordings, 1):
        entry, velocity = f"[[recording]] {number}", recording.v_H0
        if recording.file in files:
            yield f'{entry} file = "{printable(recording.file)}" is given twice; remove one'
        if velocity is not None and "v_H0" in setup.fixed:
            yield f"{entry} v_H0 = {velocity:g} is also in [fixed]; remove one of them"
        if velocity is not None and not lower <= velocity <= upper:
            yield f"{entry} v_H0 = {velocity:g} is outside its [bounds] {lower:g} to {upper:g}; correct one"
        files |= {recording.file} if recording.file else set()


def _stroke_contradictions(setup: Setup) -> Iterator[str]:
    """Strokes with two velocities, or with two recordings through one output path."""
    observed: dict[tuple[str, str | None], int] = {}
    velocities: dict[tuple[str, str], float] = {}
    for number, recording in enumerate(setup.recordings, 1):
        if recording.stroke is None:
            continue
        entry = f'[[recording]] {number} stroke = "{printable(recording.stroke)}"'
        other = observed.setdefault((recording.stroke, recording.group), number)
        if other != number:
            name = recording.group
            group = "neither has a group" if name is None else f'both have group = "{printable(name)}"'
            yield (
                f"{entry} is also the stroke of [[recording]] {other}, and {group}; a microphone records a stroke "
                "once: give each its own group, or another stroke"
            )
        for name in ("v_H0", "midi_velocity"):
            velocity = getattr(recording, name)
            if velocity is None or (first := velocities.setdefault((recording.stroke, name), velocity)) == velocity:
                continue
            yield f"{entry} has {name} = {velocity:g} and {first:g}; one stroke has one velocity: correct one of them"
