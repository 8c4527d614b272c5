"""Text of SFZ files: their regions, with all opcodes that apply, and the opcodes that no version of SFZ defines.

Comments, `#include`, `#define`, headers and inherited opcodes are resolved. SFZ has no conditions, so a file that
includes itself would never end. Such a file is rejected. Every other number of includes is allowed, and only the length
of the expanded text is limited.
"""

import codecs
import difflib
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

from ..errors import SetupError
from ..io.files import printable, read_file
from .library_files import find_file

MAX_BYTES = 2**24  # of one file: the largest libraries have 2 MiB
MAX_TEXT = 2**24  # characters of the expanded text, plus one for each piece; bounds time and memory
INCLUDE_COST = 200  # characters that one include counts as, for its time
MAX_DEPTH = 50  # of nested includes: libraries use 2 or 3, and the stack of Python ends near 300
LEVELS = ("control", "global", "master", "group", "region")
_COMMENT = re.compile(r"//[^\r\n]*|/\*.*?(?:\*/|\Z)", re.DOTALL)
_VARIABLE = re.compile(r"\$\w+")
_DIRECTIVE = re.compile(
    r"""#include[ \t]+(?:"([^"]+)"|(\S+))|#define[ \t]+(\$\w+)(?:[ \t]+(?!#include|#define|<)(\S+))?"""
)
_TOKEN = re.compile(r"<(\w+)>|(?<![^\s>])(\w+)=", re.ASCII)
_MODULATION = re.compile(r"_?(?:on|curve|smooth|step)?_?(?:hd)?cc\d+$")  # suffix of an opcode, such as _oncc74
# Opcodes that decide which sample belongs to which key. A name near one of them is probably a typing error.
KEY_OPCODES = "default_path|end|hikey|hivel|key|lokey|lovel|note_offset|octave_offset|sample|trigger"
KEY_OPCODES += "|pitch_keycenter|pitch_keytrack"
# All names of SFZ 1, SFZ 2 and ARIA, without numbers and modulations, by https://sfzformat.com/opcodes. Every name is
# defined that begins as an envelope, LFO, equaliser, switch, crossfade or label.
_OPCODE = re.compile(
    r"(?:ampeg_|amplfo_|amp_|apan_|bend|bus|cc_|comp_|curve_|cutoff|decim_|delay|directtomain|disto_|dyn_|effect|eg_|eq_|"
    r"fileg_|fillfo_|filtype|fil_|fx|gate_|global_|group_|hint_|image|label_|lfo_|loop|master_|noise_|note_|offset|off_|"
    r"on_|oscillator|param_|phaser_|pitcheg_|pitchlfo_|polyphony|position|region_|resonance|reverb_|reverse_|ringmod_|rt_|"
    r"scale_|seq_|set_|smoothing|sostenuto_|start_|static_|stop_|strings_|sustain_|sw_|tdfir_|var|vendor_|width|xfin_|"
    r"xfout_|xf_).*|"
    r"ampeg|amplitude|amplitude_smooth|count|default_instrument|direction|dsp_order|egtype|fadein|fadeout|ff|filter|gain|"
    r"gain_random|group|hi|hibend|hibpm|hicc|hichan|hichanaft|hihdcc|hipolyaft|hiprog|hirand|hitimer|internal|"
    r"invert_phase|label|lo|load_end|load_mode|load_start|lobend|lobpm|locate|locc|lochan|lochanaft|lohdcc|lopolyaft|"
    r"loprog|lorand|lotimer|md|off|pan|pan_keycenter|pan_keytrack|pan_law|pan_veltrack|phase|pitch|pitch_curve|"
    r"pitch_random|pitch_smooth|pitch_veltrack|ram_based|reload|reverse|rt|sample_dyn_param|sample_fadeout|sample_quality|"
    r"set|sostenuto|sustain|sw|sync_beats|sync_offset|transpose|tune|type|unison|v|velcurve|volume|volume_random|"
    rf"waveguide|zone|{KEY_OPCODES}"
)
# Current names by the names of early players; a trailing number is kept.
CURRENT_NAMES = {
    "loopmode": "loop_mode",
    "loopstart": "loop_start",
    "loopend": "loop_end",
    "offby": "off_by",
    "bendup": "bend_up",
    "benddown": "bend_down",
    "bendstep": "bend_step",
    "filtype": "fil_type",
    "start_locc": "on_locc",
    "start_hicc": "on_hicc",
    "gain_cc": "volume_oncc",
}
MIN_SIMILARITY = 0.85  # similarity of two names by difflib, above which one is suggested for the other


class SfzText:
    """Reads an SFZ file and the files that it includes.

    Parameters
    ----------
    source : the SFZ file. Included files are relative to its folder, or else to the folder of the including file.
    root : the folder, resolved, that included files must lie in.
    """

    def __init__(self, source: Path, root: Path) -> None:
        self.source, self._root = source, root
        self.recoded: list[Path] = []  # files that are not UTF-8
        self._defined: dict[str, str] = {}
        self._lengths: list[int] = []  # of the names in `_defined`, longest first
        self._texts: dict[Path, str] = {}
        self._files: dict[tuple[str, Path], Path] = {}
        self._left = MAX_TEXT

    def pieces(self, file: Path, stack: tuple[Path, ...] = ()) -> Iterator[str]:
        """Lines, or parts of lines around a directive. Includes and variables are replaced by their text."""
        stack = (*stack, file.resolve())
        if len(stack) > MAX_DEPTH:
            raise SetupError(f"{printable(file)}: more than {MAX_DEPTH} files include one another; put them into one")
        for line in self._text(file).splitlines():
            start = 0
            for match in _DIRECTIVE.finditer(line):
                yield self._expanded(line[start : match.start()])
                start = match.end()
                quoted, bare, word, value = match.groups()
                if word:
                    self._define(word, self._expanded(value or ""))
                else:
                    included = self._included(self._expanded(quoted or bare), file, stack)
                    yield from self.pieces(included, stack)
            yield self._expanded(line[start:])

    def _text(self, file: Path) -> str:
        """Text of a file without comments. If it is not valid UTF-8, all of it is read as Windows-1252."""
        if file in self._texts:
            return self._texts[file]
        data = read_file(file, MAX_BYTES, SetupError)
        if data[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
            raise SetupError(f"{printable(file)}: is UTF-16 text; save it as UTF-8")
        if b"\0" in data:
            line = data[: data.index(0)].count(10) + 1
            raise SetupError(f"{printable(file)}: has a zero byte on line {line}; it is not a text file")
        try:
            text = data.decode("utf-8-sig")
        except UnicodeDecodeError:
            self.recoded.append(file)
            text = data.decode("cp1252", errors="replace")
        return self._texts.setdefault(file, _COMMENT.sub(lambda m: "\n" * m[0].count("\n") or " ", text))

    def _define(self, word: str, value: str) -> None:
        self._defined[word] = value
        if len(word) not in self._lengths:
            self._lengths = sorted([*self._lengths, len(word)], reverse=True)

    def _expanded(self, text: str) -> str:
        """Text with variables replaced, the longest name first. Its length counts towards `MAX_TEXT`."""

        def value(match: re.Match[str]) -> str:
            names = (match[0][:length] for length in self._lengths)
            name = next((name for name in names if name in self._defined), "")
            value = self._defined.get(name, "")
            self._count(len(value))
            return value + match[0][len(name) :]

        self._count(len(text) + 1)
        return _VARIABLE.sub(value, text) if "$" in text else text

    def _count(self, characters: int) -> None:
        self._left -= characters
        if self._left < 0:
            limit = f"{MAX_TEXT // 2**20} MiB of text"
            raise SetupError(
                f"{printable(self.source)}: its includes and variables expand to more than {limit}; split the library"
            )

    def _included(self, name: str, file: Path, stack: tuple[Path, ...]) -> Path:
        """Path of an included file. It must lie inside the root and must not be open already."""
        self._count(INCLUDE_COST)
        included = self._files.get((name, file)) or self._files.setdefault((name, file), self._find(name, file))
        if included in stack:
            cycle = f"{printable(file)}: includes {printable(name)}, which includes itself"
            raise SetupError(f"{cycle}; remove one #include")
        return included

    def _find(self, name: str, file: Path) -> Path:
        """Path of the file `name` in the folder of the library, or else in the folder of `file`."""
        problems = []
        for folder in (self.source.parent, file.parent):
            try:
                return find_file(name, folder, self._root)
            except SetupError as problem:
                problems.append(problem)
        raise SetupError(f"{printable(file)}: includes {problems[0]}")


def regions(text: SfzText) -> Iterator[dict[str, str]]:
    """Opcodes of every region, including inherited ones."""
    levels: dict[str, dict[str, str]] = {level: {} for level in LEVELS}
    current = "control"
    for header, opcode, value in _tokens(text):
        if header:
            if current == "region":
                yield _merged(levels)
            current = header
            below = LEVELS[LEVELS.index(header) :] if header in LEVELS and header != "control" else ()
            levels |= {level: {} for level in below}
        elif current in LEVELS:
            levels[current][opcode] = value
    if current == "region":
        yield _merged(levels)


def _merged(levels: dict[str, dict[str, str]]) -> dict[str, str]:
    """Opcodes of a region. `key` sets `lokey`, `hikey` and `pitch_keycenter`, and replaces inherited values."""
    merged: dict[str, str] = {}
    for level in LEVELS:
        if "key" in levels[level]:
            for name in ("lokey", "hikey", "pitch_keycenter"):
                merged.pop(name, None)
        merged |= levels[level]
    return merged


def _tokens(text: SfzText) -> Iterator[tuple[str, str, str]]:
    """Headers and opcodes in order: (header, "", "") or ("", opcode, value). A value may contain spaces."""
    for piece in text.pieces(text.source):
        matches = [*_TOKEN.finditer(piece)]
        ends = [*(match.start() for match in matches[1:]), len(piece)]
        for match, end in zip(matches, ends, strict=False):
            header, opcode = (match[1] or "").lower(), (match[2] or "").lower()
            yield header, opcode, "" if header else piece[match.end() : end].strip()


def unrecognised_opcodes(names: Iterable[str]) -> list[str]:
    """Older and undefined names in alphabetical order, each with its current or likely intended name.

    Examples
    --------
    >>> from pianofit.batch.sfz_text import unrecognised_opcodes
    >>> unrecognised_opcodes(["sample", "pitch_keycentre", "eg06_time2", "loopmode", "frobnicate"])
    ['frobnicate', 'loopmode (today loop_mode)', 'pitch_keycentre (did you mean pitch_keycenter?)']
    """
    return [text for name in sorted(set(names)) if (text := _unrecognised(name))]


def _unrecognised(name: str) -> str:
    """An older or undefined name with its current or likely intended name; empty for a defined name."""
    stem = name.rstrip("0123456789")
    if stem in CURRENT_NAMES:
        return f"{name} (today {CURRENT_NAMES[stem]}{name[len(stem) :]})"
    key_opcodes = KEY_OPCODES.split("|")
    if name in key_opcodes:
        return ""
    mistyped = difflib.get_close_matches(name, ("sample", "pitch_keycenter", "default_path"), 1, MIN_SIMILARITY)
    if not mistyped and _OPCODE.fullmatch(re.sub(r"\d+", "", _MODULATION.sub("", name))):
        return ""
    near = difflib.get_close_matches(name, key_opcodes, 1, MIN_SIMILARITY)
    return f"{name} (did you mean {near[0]}?)" if near else name
