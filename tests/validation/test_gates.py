"""Every limit of ``validation/gates.toml`` is checked on fixtures and real images.

All numbers come from the report, which runs each stage as a process and recomputes its results.
Gates of scenes whose photographs are not on this machine are skipped.
"""

from functools import cache

import pytest

from validation.runs.processes import own_cores
from validation.runs.records import IMAGE_SCENES, ReportOptions, available_scenes
from validation.runs.report import run_tasks
from validation.runs.results import collect, read_gates
from validation.stages import STAGES

pytestmark = pytest.mark.slow
GATES = read_gates()
ALWAYS = ("courtyard", "boards", "cloud", "street")  # Scenes that this repository makes or ships
HERE = available_scenes(quick=False)
LIMIT_S = 900.0  # A machine with much other work is no broken gate


def scene_of(gate):
    return gate.key.split("/")[1]


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """The numbers of the scenes that are always there, and of the others."""

    @cache
    def run(always):
        here = [s for s in HERE if (s in ALWAYS) == always]
        wanted = {tuple(key.split("/")[:2]) for key in GATES}
        scenes = tuple(s for s in here if any(scene == s for _, scene in wanted))
        stages = tuple(name for name in STAGES if any(stage == name for stage, _ in wanted))
        out = tmp_path_factory.mktemp("gates")
        options = ReportOptions(
            out, scenes, stages, quick=True, gates_only=True, threads=len(own_cores()), limit_s=LIMIT_S
        )
        return collect(options, run_tasks(options, STAGES, lambda _: None), GATES)

    return run


@pytest.mark.parametrize(
    "gate",
    [
        pytest.param(gate, id=key, marks=() if scene_of(gate) in ALWAYS else pytest.mark.real)
        for key, gate in GATES.items()
    ],
)
def test_every_gate_holds(gate, results):
    scene = scene_of(gate)
    if scene not in HERE:
        pytest.skip(f"{scene} is not on this machine (THESISRECON_DATA)")
    reported = results(scene in ALWAYS)
    found = [row for row in reported.rows if row.key == gate.key]
    assert found, f"no stage reported this number; failures: {dict(reported.failures)}"
    assert gate.holds(found[0].value), f"{found[0].value} {found[0].unit}, {gate.reason}"


def test_every_image_set_has_gates():
    assert {scene_of(gate) for gate in GATES.values()} >= {*IMAGE_SCENES, *ALWAYS}
