"""The record of results under its former command line; ``python -m validation study record`` is the same."""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from validation.studies.record import IMAGE_SETS, PRESETS, TRACKS, compare, write


def main(arguments: list[str] | None = None) -> int:
    """``write FILE`` or ``compare BEFORE AFTER``."""
    parser = argparse.ArgumentParser(prog="python -m validation.record_results", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    writing = commands.add_parser("write")
    writing.add_argument("file", type=Path)
    writing.add_argument("--folder", type=Path, help="keep the output folders here")
    writing.add_argument("--sets", nargs="+", default=[*TRACKS, *IMAGE_SETS])
    writing.add_argument("--presets", nargs="+", default=list(PRESETS))
    comparing = commands.add_parser("compare")
    comparing.add_argument("before", type=Path)
    comparing.add_argument("after", type=Path)
    options = parser.parse_args(arguments)
    if options.command == "compare":
        found = list(compare(options.before, options.after))
        print(*(text for text, _ in found), sep="\n")
        return int(any(differs for _, differs in found))
    with tempfile.TemporaryDirectory() as place:
        for line in write(options.file, options.folder or Path(place), options.sets, options.presets):
            print(line, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
