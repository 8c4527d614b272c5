"""Calls of a higher package by methods of public types, such as `Note.play` and `Result.report`.

Packages import in one direction: a page imports the result that it shows. A method of the result that writes the page
would be an import in the other direction. It calls by name here, and the table names all such calls.
"""

from importlib import import_module
from typing import Any

# The functions and classes that may be called, by module.
TARGETS = {
    "web.widget": ("widget",),
    "report.plots": ("Plots",),
    "report.save": ("save", "write_page"),
    "report.summary": ("fit_summary",),
}


def call(module: str, name: str, *args: Any, **kwargs: Any) -> Any:
    """Import a module of this package and call a function or class of it, which `TARGETS` must list."""
    return getattr(import_module(f".{module}", __package__), name)(*args, **kwargs)
