"""A stage with references that do all that a reference may do: answer, be missing, fail, crash, hang."""

import json
import os
import shutil
import signal
import time

import PIL.Image

from thesisrecon.errors import StageFailure
from validation.runs.records import Judgement, Picture
from validation.runs.tables import Metric, Plot

VALUES = {"ours": 0.5, "good": 2.0, "after": 4.0}
WAYS = ("ours", "good", "missing", "failing", "crashing", "hanging")


class ToyStage:
    name = "toy"
    title = "A <b>toy</b>"
    definition = "Numbers that were saved."

    def takes(self, scene, options):
        return scene == "yard"

    def methods(self, scene, options):
        return ("ours", "good") if options.quick else ("after", *WAYS)

    def needs(self, method):
        return (("toy", "good"),) if method == "after" else ()

    def run(self, task, folder, options):
        if task.method == "missing":
            import no_such_library  # noqa: F401
        if task.method == "failing":
            shutil.rmtree(folder)  # as one that starts with an empty folder does
            raise StageFailure("the toy is broken", "it has 1 wheel", "buy another")
        if task.method == "crashing":
            os.kill(os.getpid(), signal.SIGSEGV)
        if task.method == "hanging":
            (folder / "process").write_text(str(os.getpid()))
            while True:
                pass
        value = VALUES[task.method]
        if task.method == "after":
            value *= json.loads((options.folder("toy", task.scene, "good") / "value.json").read_text())
        (folder / "value.json").write_text(json.dumps(value))

    def judge(self, scene, outcomes, options):
        values = {
            name: json.loads((o.folder / "value.json").read_text()) if o.ok else None
            for name, o in outcomes.items()
        }
        metrics = [
            Metric(scene, "wheels, lost", "px", values, "ours", definition='"less" is <better>'),
            Metric(scene, "time", "s", {"ours": time.time()}, "ours"),
        ]
        PIL.Image.new("RGB", (40, 30), (200, 10, 10)).save(options.folder(self.name, scene) / "red.png")
        plots = [Plot("Wheels", {"data": [{"type": "scatter", "y": [1, 2]}], "layout": {}})]
        return Judgement(metrics, ["A </script> note."], plots, [Picture("red.png", "Red")])


STAGES = {"toy": ToyStage()}
