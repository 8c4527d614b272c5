"""Warnings of several recordings are pooled into few lines."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from pianofit.analysis import beating_warning
from pianofit.result.warnings import recording_warnings


class Table:
    """Partials with only their beating."""

    def __init__(self, beating):
        self.beating = np.array(beating)

    def __len__(self):
        return len(self.beating)


def pooled(beats, warnings):
    recordings = [SimpleNamespace(path=f"/folder/r{i}.wav", warnings=own) for i, own in enumerate(warnings)]
    tables = [Table(beating) for beating in beats]
    analyses = [
        SimpleNamespace(partials=table, warnings=tuple(filter(None, [beating_warning(table)]))) for table in tables
    ]
    return recording_warnings(recordings, analyses)


def test_beats_of_many_recordings_are_one_line_that_names_them():
    lines = pooled([[3.0, 0.1], [0.2, 0.1, 0.0], [2.0, 2.0], [1.4], [1.6, 9.0, 0.0]], [()] * 5)
    (line,) = lines
    assert "3 of 5" in line
    for name, count in (("r0.wav", "1 of 2"), ("r2.wav", "2 of 2"), ("r4.wav", "2 of 3")):
        assert f"{name} ({count}" in line
    assert "r1.wav" not in line
    assert "r3.wav" not in line
    assert "/folder" not in line


def test_a_warning_that_recordings_share_is_one_line():
    lines = pooled([[0.0]] * 3, [("clipped",), (), ("clipped", "an offset")])
    assert lines == ["r0.wav, r2.wav: clipped", "r2.wav: an offset"]
    assert pooled([[0.0]] * 2, [("clipped",)] * 2) == ["all 2 recordings: clipped"]


def test_a_single_recording_is_not_named():
    (line,) = pooled([[3.0]], [("clipped",)])
    assert line.startswith("clipped; 1 of 1 ")
    assert pooled([[0.0]], [()]) == []
