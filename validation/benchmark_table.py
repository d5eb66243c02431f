"""The ratios of a benchmark: ``python -m validation.benchmark_table BENCHMARK.json [-o RATIOS.json]``.

BENCHMARK.json is what pytest-benchmark writes for ``benchmarks/``. Both methods of a group ran in the same
process on the same machine; their least processor times are compared, which other work disturbs least.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from thesisrecon.io.files import write_text

OURS = "ours"


def least_seconds(told: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    """Group -> method -> least seconds of a call."""
    groups: dict[str, dict[str, float]] = {}
    for entry in told["benchmarks"]:
        groups.setdefault(entry["group"], {})[entry["extra_info"]["method"]] = float(entry["stats"]["min"])
    return groups


def ratios_to_ours(groups: Mapping[str, Mapping[str, float]]) -> dict[str, dict[str, float]]:
    """Group -> reference -> time of ours over that of the reference; groups without ours are left out."""
    return {
        group: {name: times[OURS] / seconds for name, seconds in times.items() if name != OURS}
        for group, times in groups.items()
        if OURS in times
    }


def ratio_table(groups: Mapping[str, Mapping[str, float]]) -> str:
    """Markdown: a row for each group and method."""
    lines = ["| | method | ms a call | ours / this |", "| --- | --- | --- | --- |"]
    ratios = ratios_to_ours(groups)
    for group, times in groups.items():
        for name, seconds in times.items():
            ratio = ratios.get(group, {}).get(name)
            over = "" if ratio is None else f"**{ratio:.2f}**"
            lines.append(f"| {group} | {name} | {1e3 * seconds:.3g} | {over} |")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m validation.benchmark_table", description=__doc__)
    parser.add_argument("benchmark", type=Path)
    parser.add_argument("-o", "--out", type=Path, help="a JSON file for the ratios")
    wishes = parser.parse_args(arguments)
    try:
        groups = least_seconds(json.loads(wishes.benchmark.read_text(encoding="utf-8")))
    except (OSError, ValueError, KeyError, TypeError) as error:
        print(f"{wishes.benchmark} is no benchmark of ours: {error}", file=sys.stderr)
        return 2
    print(ratio_table(groups))
    if wishes.out is not None:
        told = {"seconds": groups, "ours_over": ratios_to_ours(groups)}
        write_text(wishes.out, json.dumps(told, indent=1))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
