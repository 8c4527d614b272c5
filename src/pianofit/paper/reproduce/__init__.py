"""The paper, again: its tables, its figures and its claims, each tested by numbers of this run.

Bensa, Gipouloux and Kronland-Martinet (2005) fitted recordings that are not public. Here the laboratory's measurements
stand for them, whose truth is known and which contain what the paper's model leaves out. One page says what came out
and what did not, with the files behind it; every sentence of judgement is chosen by numbers (`verdict`).
"""

from .plan import FULL, QUICK, Plan
from .run import reproduce
from .verdict import Verdict

__all__ = ["FULL", "QUICK", "Plan", "Verdict", "reproduce"]
