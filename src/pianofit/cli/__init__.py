"""The command line: one file a group of commands."""

from .program import app, main, run

__all__ = ["app", "main", "run"]
