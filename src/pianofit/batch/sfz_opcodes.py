"""Names of the SFZ opcodes, to recognise those that no version of the format defines: typing errors and old dialects.

Names are compared without their numbers and without the suffix of a modulation, such as `_oncc74`. The list follows
the tables of SFZ 1, SFZ 2 and ARIA at https://sfzformat.com/opcodes.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable

__all__ = ["not_of_today"]

# Opcodes that decide which sample belongs to which key. A name near one of them is probably a typing error.
READ = (
    "sample", "default_path", "note_offset", "octave_offset", "key", "lokey", "hikey", "pitch_keycenter",
    "pitch_keytrack", "lovel", "hivel", "trigger", "end",
)  # fmt: skip
# Names of early players by those of today; a trailing number is kept.
OLDER = {
    "loopmode": "loop_mode", "loopstart": "loop_start", "loopend": "loop_end", "offby": "off_by", "bendup": "bend_up",
    "benddown": "bend_down", "bendstep": "bend_step", "filtype": "fil_type", "start_locc": "on_locc",
    "start_hicc": "on_hicc", "gain_cc": "volume_oncc",
}  # fmt: skip
NEAR = 0.85  # similarity of two names by difflib, from which on one is suggested for the other
# Any name with one of these beginnings is defined: envelopes, LFOs, equalisers, switches, crossfades, labels.
FAMILIES = (
    "ampeg_", "fileg_", "pitcheg_", "amplfo_", "fillfo_", "pitchlfo_", "eg_", "lfo_", "eq_", "fil_", "sw_", "seq_",
    "xfin_", "xfout_", "xf_", "loop", "delay", "offset", "sustain_", "sostenuto_", "effect", "fx_", "param_", "label_",
    "set_", "hint_", "global_", "master_", "group_", "region_", "reverb_", "comp_", "gate_", "disto_", "decim_",
    "phaser_", "strings_", "tdfir_", "static_", "apan_", "dyn_", "oscillator", "noise_", "polyphony", "note_", "off_",
    "bend", "cutoff", "resonance", "filtype", "ringmod_", "scale_", "start_", "stop_", "on_", "var_", "var", "image",
    "curve_", "amp_", "rt_", "smoothing", "bus", "directtomain", "cc_", "vendor_", "width", "position",
    "fx", "reverse_",
)  # fmt: skip
OTHERS = (
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


def not_of_today(names: Iterable[str]) -> list[str]:
    """Older names, and names that no version of SFZ defines, in alphabetical order, each with today's or a likely one.

    Examples
    --------
    >>> from pianofit.batch.sfz_opcodes import not_of_today
    >>> not_of_today(["sample", "pitch_keycentre", "eg06_time2", "loopmode", "frobnicate"])
    ['frobnicate', 'loopmode (today loop_mode)', 'pitch_keycentre (did you mean pitch_keycenter?)']
    """
    return [found for name in sorted(set(names)) if (found := _older(name) or _unknown(name))]


def _older(name: str) -> str:
    """An older name with today's; empty for other names."""
    stem = name.rstrip("0123456789")
    return f"{name} (today {OLDER[stem]}{name[len(stem) :]})" if stem in OLDER else ""


def _unknown(name: str) -> str:
    """A name that is not defined, with the likely intended one; empty for a name that is."""
    return "" if _defined(name) else _with_suggestion(name)


def _defined(name: str) -> bool:
    if name in READ:
        return True
    if difflib.get_close_matches(name, ("sample", "pitch_keycenter", "default_path"), 1, NEAR):
        return False
    bare = re.sub(r"\d+", "", _MODULATION.sub("", name))
    return bare in OTHERS or bare in READ or bare.startswith(FAMILIES)


def _with_suggestion(name: str) -> str:
    near = difflib.get_close_matches(name, READ, 1, NEAR)
    return f"{name} (did you mean {near[0]}?)" if near else name
