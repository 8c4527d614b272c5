"""Tests of the tables, figures and claims of the paper with numbers computed in one run.

Bensa, Gipouloux and Kronland-Martinet (2005) fitted recordings that are not public. Synthetic measurements of
`laboratory` replace them. Their parameters are given, and they contain effects that the paper's model does not
describe. `studies` computes, and `claims` decides by rules. The text of the page is in `index.html.j2` and `claims.j2`.
All contents of the page are also files: every figure as PNG, every table as CSV, every sound as WAV.
"""

from .claims import Claim
from .run import reproduce
from .studies import FULL, QUICK, Plan

__all__ = ["FULL", "QUICK", "Claim", "Plan", "reproduce"]
