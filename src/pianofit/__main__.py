"""Run the command line with `python -m pianofit`."""

from .cli import run

__all__: list[str] = []

if __name__ == "__main__":
    run()
