"""A sampler's text in SFZ: a group for each key, a region for each layer, with its own curve over velocity."""

from __future__ import annotations

from collections.abc import Sequence

from .layers import SampledKey, Zone

__all__ = ["sfz_text"]

# An envelope is released to this level, in nepers, in the time `ampeg_release` says. SFZ leaves it open; sfizz has 9.
RELEASED = 9.0


def sfz_text(title: str, keys: Sequence[SampledKey]) -> str:
    """The `.sfz`. Curves hold every velocity: players need not agree on what is between."""
    lines = [f"// {title}: strings and hammers, played by pianofit", "<global> amp_veltrack=100 ampeg_attack=0", ""]
    for key in keys:
        # The damper raises the decay of every mode alike, as an exponential envelope does.
        end = f"ampeg_release={RELEASED / key.damper:.4f}" if key.damper else "loop_mode=one_shot"
        lines.append(f"<group> lokey={key.low} hikey={key.high} pitch_keycenter={key.midi} {end}")
        lines += [_region(zone, file) for zone, file in zip(key.zones, key.files, strict=True)]
    return "\n".join(lines) + "\n"


def _region(zone: Zone, file: str) -> str:
    curve = [f"amp_velcurve_{zone.low + i}={gain:.5g}" for i, gain in enumerate(zone.gain)]
    return f"<region> lovel={zone.low} hivel={zone.high} sample={file} {' '.join(curve)}"
