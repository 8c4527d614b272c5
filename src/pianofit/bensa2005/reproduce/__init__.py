"""The paper, again: its tables, its figures and its claims, each tested by numbers of this run.

Bensa, Gipouloux and Kronland-Martinet (2005) fitted recordings that are not public. Here the laboratory's measurements
stand for them, whose truth is known and which contain what the paper's model leaves out. `studies` computes, `claims`
decides by rules, and the page's text stands by hand in `index.html.j2` and `claims.j2`, around the numbers. What is on
the page is also in a file: every figure as PNG, every table as CSV, every sound as WAV.
"""

from .claims import Claim
from .run import reproduce
from .studies import FULL, QUICK, Plan

__all__ = ["FULL", "QUICK", "Claim", "Plan", "reproduce"]
