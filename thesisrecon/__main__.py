"""``python -m thesisrecon``, and the command ``thesisrecon``."""

from __future__ import annotations

from thesisrecon.runtime.signals import obey_signals


def main() -> None:
    """The entry point of the command; the rest is loaded when Ctrl-C is already obeyed."""
    obey_signals("thesisrecon")
    from thesisrecon.cli.main import main as run

    run()


if __name__ == "__main__":
    main()
