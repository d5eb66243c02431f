"""``python -m validation``."""

from __future__ import annotations

from thesisrecon.runtime.signals import obey_signals


def main() -> int:
    """The command; the rest is loaded when Ctrl-C is already obeyed."""
    obey_signals("validation")
    from validation.command import main as run

    return run()


if __name__ == "__main__":
    raise SystemExit(main())
