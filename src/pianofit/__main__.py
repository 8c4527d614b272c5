"""Run the command line: `pianofit`, or `python -m pianofit`."""

from .io.interrupts import cleanup_on_interrupt

__all__: list[str] = []


def run() -> None:
    """Run the command line. Interrupts are handled before the commands are imported, because that takes a second."""
    with cleanup_on_interrupt():
        from .cli import run as run_command

        run_command()


if __name__ == "__main__":
    run()
