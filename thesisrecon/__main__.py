"""``python -m thesisrecon``, and the command ``thesisrecon``."""

from thesisrecon.runtime._signals import install_signal_handlers


def main() -> None:
    """Run the command; the rest is imported after the signal handlers are installed."""
    install_signal_handlers("thesisrecon")
    from thesisrecon.cli.commands import main as run

    run()


if __name__ == "__main__":
    main()
