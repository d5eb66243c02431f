"""``python -m thesisrecon``, and the command ``thesisrecon``."""

from __future__ import annotations

from thesisrecon.runtime.signals import install_signal_handlers


def main() -> None:
    """The entry point of the command; the rest is loaded when Ctrl-C is already obeyed."""
    install_signal_handlers("thesisrecon")
    from thesisrecon.cli.main import main as run

    run()


if __name__ == "__main__":
    main()
