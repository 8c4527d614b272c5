"""Names of the SFZ opcodes, to detect typing errors and names of old players.

Names are compared without their numbers and without the suffix of a modulation, such as `_oncc74`. The list follows
the tables of SFZ 1, SFZ 2 and ARIA at https://sfzformat.com/opcodes.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable

__all__ = ["unrecognised_opcodes"]

# Opcodes that decide which sample belongs to which key. A name near one of them is probably a typing error.
KEY_OPCODES = (
    "sample", "default_path", "note_offset", "octave_offset", "key", "lokey", "hikey", "pitch_keycenter",
    "pitch_keytrack", "lovel", "hivel", "trigger", "end",
)  # fmt: skip
# Current names by the names of early players; a trailing number is kept.
CURRENT_NAMES = {
    "loopmode": "loop_mode", "loopstart": "loop_start", "loopend": "loop_end", "offby": "off_by", "bendup": "bend_up",
    "benddown": "bend_down", "bendstep": "bend_step", "filtype": "fil_type", "start_locc": "on_locc",
    "start_hicc": "on_hicc", "gain_cc": "volume_oncc",
}  # fmt: skip
MIN_SIMILARITY = 0.85  # similarity of two names by difflib, above which one is suggested for the other
# Every name with one of these prefixes is defined: envelopes, LFOs, equalisers, switches, crossfades, labels.
PREFIXES = (
    "ampeg_", "fileg_", "pitcheg_", "amplfo_", "fillfo_", "pitchlfo_", "eg_", "lfo_", "eq_", "fil_", "sw_", "seq_",
    "xfin_", "xfout_", "xf_", "loop", "delay", "offset", "sustain_", "sostenuto_", "effect", "fx_", "param_", "label_",
    "set_", "hint_", "global_", "master_", "group_", "region_", "reverb_", "comp_", "gate_", "disto_", "decim_",
    "phaser_", "strings_", "tdfir_", "static_", "apan_", "dyn_", "oscillator", "noise_", "polyphony", "note_", "off_",
    "bend", "cutoff", "resonance", "filtype", "ringmod_", "scale_", "start_", "stop_", "on_", "var_", "var", "image",
    "curve_", "amp_", "rt_", "smoothing", "bus", "directtomain", "cc_", "vendor_", "width", "position",
    "fx", "reverse_",
)  # fmt: skip
OTHER_OPCODES = (
    "label", "set",
    "amplitude", "amplitude_smooth", "volume", "gain", "pan", "pan_law", "pan_keycenter", "pan_keytrack",
    "pan_veltrack", "phase", "invert_phase", "direction", "count", "sync_beats", "sync_offset", "group", "off",
    "lochan", "hichan", "loprog", "hiprog", "lobend", "hibend", "lochanaft", "hichanaft", "lopolyaft",
    "hipolyaft", "lorand", "hirand", "lobpm", "hibpm", "lotimer", "hitimer", "locc", "hicc", "lohdcc", "hihdcc",
    "lo", "hi", "pitch", "pitch_random", "pitch_veltrack", "pitch_smooth", "pitch_curve", "tune", "transpose",
    "load_mode", "load_start", "load_end", "md", "waveguide", "reverse", "ampeg", "gain_random", "internal",
    "egtype", "sample_fadeout", "sample_dyn_param", "sample_quality", "type", "filter", "velcurve", "locate",
    "default_instrument", "width_law", "volume_random", "v", "sustain", "sostenuto", "sw", "dsp_order",
    "fadein", "fadeout", "unison", "zone", "ff", "reload", "ram_based", "rt",
)  # fmt: skip
_MODULATION = re.compile(r"_?(?:on|curve|smooth|step)?_?(?:hd)?cc\d+$")


def unrecognised_opcodes(names: Iterable[str]) -> list[str]:
    """Older and undefined names in alphabetical order, each with its current or likely intended name.

    Examples
    --------
    >>> from pianofit.batch.sfz_opcodes import unrecognised_opcodes
    >>> unrecognised_opcodes(["sample", "pitch_keycentre", "eg06_time2", "loopmode", "frobnicate"])
    ['frobnicate', 'loopmode (today loop_mode)', 'pitch_keycentre (did you mean pitch_keycenter?)']
    """
    return [text for name in sorted(set(names)) if (text := _with_current_name(name) or _undefined(name))]


def _with_current_name(name: str) -> str:
    """An older name with its current name; empty for other names."""
    stem = name.rstrip("0123456789")
    return f"{name} (today {CURRENT_NAMES[stem]}{name[len(stem) :]})" if stem in CURRENT_NAMES else ""


def _undefined(name: str) -> str:
    """An undefined name with the likely intended one; empty for a defined name."""
    return "" if _defined(name) else _with_suggestion(name)


def _defined(name: str) -> bool:
    if name in KEY_OPCODES:
        return True
    if difflib.get_close_matches(name, ("sample", "pitch_keycenter", "default_path"), 1, MIN_SIMILARITY):
        return False
    bare = re.sub(r"\d+", "", _MODULATION.sub("", name))
    return bare in OTHER_OPCODES or bare in KEY_OPCODES or bare.startswith(PREFIXES)


def _with_suggestion(name: str) -> str:
    near = difflib.get_close_matches(name, KEY_OPCODES, 1, MIN_SIMILARITY)
    return f"{name} (did you mean {near[0]}?)" if near else name
