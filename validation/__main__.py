"""``python -m validation``."""

from __future__ import annotations

import sys

from thesisrecon.runtime._signals import install_signal_handlers, with_resume_advice


def main() -> int:
    """Run the command; its modules are imported after the signal handlers are set."""
    install_signal_handlers("validation")
    if sys.argv[1:2] == ["study"] and sys.argv[2:3] != ["all"]:
        # A study needs neither the stages nor the ablation.
        from validation.runs.study import run_studies

        with with_resume_advice("run the same command again"):
            return run_studies(sys.argv[2:])
    from validation.command import main as run

    return run()


if __name__ == "__main__":
    raise SystemExit(main())
