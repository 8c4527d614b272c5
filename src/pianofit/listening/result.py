"""Count the answers of listening tests: hits by condition, with intervals and p values."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from ..errors import ParameterError
from ..io.files import as_paths, printable
from ..schema.listening import read_answers


@dataclass(frozen=True)
class Count:
    """Answers to one condition."""

    condition: str
    hits: int
    of: int
    p: float  # two-sided, of a fair coin, exact
    interval: tuple[float, float]  # of the share of hits, 95 %, Clopper and Pearson (1934)


def count_answers(files: Sequence[str | os.PathLike[str]]) -> list[Count]:
    """Count the answers of all files by condition.

    Parameters
    ----------
    files : files that pages of a listening test saved, one for each listener.

    Returns
    -------
    Hits, p and interval of each condition, in order of appearance.

    Raises
    ------
    ParameterError
        If a file has no answers, or two files have the same content.

    Examples
    --------
    >>> import json
    >>> from pathlib import Path
    >>> import pianofit
    >>> trials = 9 * [{"condition": "ABX", "chosen": "a", "hit": "a"}]
    >>> _ = Path("answers.json").write_text(json.dumps({"schema": 2, "trials": trials}))
    >>> (count,) = pianofit.count_answers([Path("answers.json")])
    >>> count.hits, count.of, f"{count.p:.4f}"
    (9, 9, '0.0039')
    """
    from scipy.stats import binomtest

    hits: dict[str, list[bool]] = {}
    contents: list[Any] = []
    paths = as_paths("files", files)
    for path in paths:
        answers, content = read_answers(path)
        if content in contents:
            raise ParameterError(
                f"{printable(path)}: has the same answers as {printable(paths[contents.index(content)])}; give each "
                "file once"
            )
        contents.append(content)
        for trial in answers.trials:
            hits.setdefault(printable(trial.condition), []).append(trial.chosen == trial.hit)
    counts = []
    for condition, found in hits.items():
        test = binomtest(sum(found), len(found))
        low, high = test.proportion_ci(0.95, method="exact")
        counts.append(Count(condition, sum(found), len(found), float(test.pvalue), (float(low), float(high))))
    return counts
