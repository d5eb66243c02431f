"""Run one task in a process: ``python -m validation.harness.worker OPTIONS STAGE SCENE [METHOD]``.

Without a method, run the judgement on the outcomes in ``outcomes.json``.
"""

from __future__ import annotations

import importlib
import json
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from thesisrecon.errors import StageFailure
from thesisrecon.io._files import write_text
from validation.harness.records import Outcome, ReportOptions, Stage, Task

JUDGEMENT, OUTCOMES = "judgement.json", "outcomes.json"


def main(arguments: list[str] | None = None) -> int:
    options_file, stage, scene, *method = sys.argv[1:] if arguments is None else arguments
    options = ReportOptions.from_json(json.loads(Path(options_file).read_text(encoding="utf-8")))
    stages: dict[str, Stage] = importlib.import_module(options.stages_from).STAGES
    try:
        if method:
            place = options.place(stage, scene, method[0])
            place.mkdir(parents=True, exist_ok=True)
            stages[stage].run(Task(stage, scene, method[0]), options)
        else:
            _judge(options, stages[stage], scene)
    except (StageFailure, ImportError, ValueError) as error:
        print(error, file=sys.stderr)
        return 3
    return 0


def _judge(options: ReportOptions, stage: Stage, scene: str) -> None:
    """Store the judgement with the messages of the methods that failed."""
    place = options.place(stage.name, scene)
    outcomes = read_outcomes(place)
    judgement = stage.judge(scene, outcomes, options)
    failures = [f"{name}: {outcome.failure}." for name, outcome in outcomes.items() if not outcome.ok]
    judgement = replace(judgement, notes=[*judgement.notes, *failures])
    write_text(place / JUDGEMENT, json.dumps(asdict(judgement), default=_plain_number))


def read_outcomes(place: Path) -> dict[str, Outcome]:
    """Return the outcomes of a stage on a scene by method, those of its folder."""
    record = json.loads((place / OUTCOMES).read_text(encoding="utf-8"))
    return {name: Outcome(**{**o, "place": Path(o["place"])}) for name, o in record.items()}


def _plain_number(value: Any) -> Any:
    """Convert NumPy numbers and arrays for JSON."""
    if hasattr(value, "tolist"):
        return value.tolist()
    raise TypeError(f"{type(value)} cannot be stored in a judgement")


if __name__ == "__main__":
    raise SystemExit(main())
