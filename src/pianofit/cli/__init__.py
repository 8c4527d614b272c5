"""Command line: one module for each group of commands."""

from .program import app, main, run
