"""One task, in a process of its own: ``python -m validation.harness.worker WISHES STAGE SCENE [METHOD]``.

Without a method, the judgement on the outcomes that stand in ``outcomes.json``.
"""

from __future__ import annotations

import importlib
import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

from thesisrecon.errors import StageFailure
from thesisrecon.io.files import write_text
from validation.harness.canaries import read_refused
from validation.harness.records import Judgement, Outcome, Stage, Task, Wishes
from validation.references.libraries import refuse

JUDGEMENT, OUTCOMES = "judgement.json", "outcomes.json"


def main(arguments: list[str] | None = None) -> int:
    wishes_file, stage, scene, *method = sys.argv[1:] if arguments is None else arguments
    wishes = Wishes.from_json(json.loads(Path(wishes_file).read_text(encoding="utf-8")))
    refuse(read_refused(wishes.out))
    stages: dict[str, Stage] = importlib.import_module(wishes.stages_from).STAGES
    try:
        if method:
            place = wishes.place(stage, scene, method[0])
            place.mkdir(parents=True, exist_ok=True)
            stages[stage].run(Task(stage, scene, method[0]), wishes)
        else:
            _judge(wishes, stages[stage], scene)
    except (StageFailure, ImportError, ValueError) as error:
        print(error, file=sys.stderr)
        return 3
    return 0


def _judge(wishes: Wishes, stage: Stage, scene: str) -> None:
    place = wishes.place(stage.name, scene)
    told = json.loads((place / OUTCOMES).read_text(encoding="utf-8"))
    outcomes = {name: Outcome(**{**o, "place": Path(o["place"])}) for name, o in told.items()}
    judgement = stage.judge(scene, outcomes, wishes)
    text = json.dumps(_plain(judgement), default=_plain_number)
    write_text(place / JUDGEMENT, text)


def _plain(judgement: Judgement) -> dict[str, Any]:
    return asdict(judgement)


def _plain_number(value: Any) -> Any:
    """NumPy's numbers and arrays are none of JSON's."""
    if hasattr(value, "tolist"):
        return value.tolist()
    raise TypeError(f"{type(value)} is no part of a judgement")


if __name__ == "__main__":
    raise SystemExit(main())
