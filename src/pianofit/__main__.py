"""`python -m pianofit` is `pianofit`."""

from .cli import run

__all__: list[str] = []

if __name__ == "__main__":
    run()
