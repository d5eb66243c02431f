"""Chapter 4 beside SIFT on real photographs: ``python -m validation.studies.front_end``.

Four parts. ``pairs``: verified matches of fountain-P11 and Herz-Jesus-P8. ``kermit``: which of its 55 pairs
are related, and whether any contradicts the final cameras. ``time``: features and matching of all pairs of
fountain-P11 beside COLMAP's SIFT. ``invariance``: rotated, scaled and darkened copies of photographs. SIFT is
OpenCV's with all features, ratio 0.8 and mutual best matches.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from thesisrecon.io.files import write_text
from validation.studies.front_end_invariance import check_invariance, measure_invariance
from validation.studies.front_end_kermit import check_kermit, kermit_table, measure_kermit
from validation.studies.front_end_pairs import check_pairs, measure_pairs, pair_table
from validation.studies.front_end_time import check_time, measure_time
from validation.metrics.record import Metric, markdown_table
from validation.scenes.real_pairs import SCENES_WITH_CAMERAS

PARTS = ("pairs", "kermit", "time", "invariance")
Block = tuple[str, list[Metric], str]
"""Title, judged rows, and what else is told."""


def pair_blocks(wishes: argparse.Namespace) -> Iterator[Block]:
    """One block for each scene and gap."""
    for scene in SCENES_WITH_CAMERAS:
        for gap in wishes.gaps:
            pairs = list(measure_pairs(scene, (gap,), wishes.cache))
            if pairs:
                yield f"{scene}, (i, i+{gap})", check_pairs(scene, gap, pairs), pair_table(scene, pairs)


def blocks(wishes: argparse.Namespace) -> Iterator[Block]:
    """What was asked for."""
    parts = PARTS if wishes.only is None else (wishes.only,)
    if "pairs" in parts:
        yield from pair_blocks(wishes)
    if "kermit" in parts:
        run = measure_kermit()
        if run is not None:
            yield "kermit, all pairs", check_kermit(run), kermit_table(run)
    if "time" in parts:
        runs = measure_time()
        if runs is not None:
            yield "Time and memory, fountain-P11, 2 threads", check_time(runs), ""
    if "invariance" in parts:
        for title, copies in measure_invariance().items():
            yield f"Copies of {title}", check_invariance(title, copies), ""


def main(arguments: list[str] | None = None) -> int:
    """Print the tables; 1 where a target is missed, 3 where there are no photographs."""
    parser = argparse.ArgumentParser(prog="python -m validation.studies.front_end", description=__doc__)
    parser.add_argument("--only", choices=PARTS)
    parser.add_argument("--gaps", type=int, nargs="+", default=[1, 2, 3])
    default = Path(tempfile.gettempdir()) / "thesisrecon-matches"
    parser.add_argument("--cache", type=Path, default=default, help="folder that keeps the SIFT matches")
    parser.add_argument("-o", "--out", type=Path, help="a Markdown file for the tables")
    wishes = parser.parse_args(arguments)
    missed, told = False, []
    for title, rows, more in blocks(wishes):
        told.append("\n\n".join(part for part in (f"## {title}", markdown_table(rows), more) if part) + "\n")
        print(told[-1], flush=True)
        missed |= any(row.verdict == "missed" for row in rows)
        if wishes.out is not None:
            # After each block, so that a run cut short keeps what it has.
            wishes.out.parent.mkdir(parents=True, exist_ok=True)
            write_text(wishes.out, "\n".join(told))
    if not told:
        print("the photographs are not on this machine (THESISRECON_DATA)", file=sys.stderr)
        return 3
    return int(missed)


if __name__ == "__main__":
    raise SystemExit(main())
