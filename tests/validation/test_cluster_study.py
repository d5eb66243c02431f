"""Simulated clusters: list scheduling of cases with known answers, and a toy run."""

import pickle

import pytest

from tests.pipeline.fake_stages import fake_config, kept_bytes, photographs
from thesisrecon.api.reconstruct import reconstruct
from validation.studies.cluster_efficiency import Task, TaskMeter, critical_path, efficiency_table


def tasks_of(*seconds, sent=0, received=0):
    return [Task(s, sent, received) for s in seconds]


@pytest.mark.parametrize(
    ("seconds", "workers", "expected"),
    [
        ((), 3, 0.0),
        ((5.0,), 4, 5.0),
        ((1.0, 2.0, 3.0), 1, 6.0),
        ((1.0,) * 8, 4, 2.0),
        # Graham (1969): the long task is submitted last.
        ((1.0, 1.0, 1.0, 1.0, 2.0), 2, 4.0),
        ((2.0, 1.0, 1.0, 1.0, 1.0), 2, 3.0),
        # The second worker is free first and takes the third and the fourth task.
        ((4.0, 1.0, 1.0, 1.0, 3.0), 2, 6.0),
    ],
)
def test_a_task_goes_to_the_first_free_worker(seconds, workers, expected):
    assert critical_path(tasks_of(*seconds), workers) == expected


def test_arguments_and_results_share_one_line_each_way():
    # Arguments leave at 2, 4, 6 and 8 s, and all workers wait for them.
    assert critical_path(tasks_of(1, 1, 1, 1, sent=20), 4, 10.0) == 9.0
    # Results of 2 s each queue behind the first, which is there at 1 s.
    assert critical_path(tasks_of(1, 1, 1, 1, received=20), 4, 10.0) == 9.0
    # One worker: the next arguments travel during the calculation.
    assert critical_path(tasks_of(3, 3, 3, sent=10), 1, 10.0) == 10.0
    # The third arguments leave when the first result is there, and arrive after the second is computed.
    assert critical_path(tasks_of(1, 1, 1, sent=10), 1, 10.0) == 4.0
    assert critical_path(tasks_of(1, 1, 1, sent=20), 1, 10.0) == 7.0


def test_a_toy_run_is_measured_task_by_task_and_its_result_is_the_same(tmp_path):
    meter, given = TaskMeter(), {"config": fake_config(), "threads": 1}
    reconstruct(photographs(5), tmp_path / "a", executor=meter, **given)
    plain = reconstruct(photographs(5), tmp_path / "b", **given)
    assert kept_bytes(tmp_path / "a") == kept_bytes(tmp_path / "b")
    found = meter.tasks(1)
    counts = {stage: len(tasks) for stage, tasks in found.items()}
    assert counts == {"features": 5, "depth maps": 5, "matches": 10}
    image = photographs(1)[0].rgb.nbytes
    assert all(task.sent > image and task.received > 500 for task in found["features"])
    # Of ten pairs each is a batch, with two images.
    assert all(2 * image < task.sent < 3 * image for task in found["matches"])
    received = sum(task.received for task in found["matches"])
    assert received == pytest.approx(sum(len(pickle.dumps([p], 5)) for p in plain.pairs), rel=0.02)
    table = efficiency_table(1.0, {workers: meter.tasks(workers) for workers in (1, 2)})
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines()]
    assert [row[:2] for row in rows if row[0] == "whole run"] == [["whole run", "1"], ["whole run", "2"]]
    assert {len(row) for row in rows} == {11}


def test_the_efficiency_is_the_work_of_one_worker_by_workers_and_path():
    one, two = tasks_of(1.0, 1.0, 2.0), tasks_of(1.5, 1.0, 2.0, sent=125_000_000)
    rows = efficiency_table(2.0, {1: {"features": one}, 2: {"features": two}}).splitlines()[2:]
    cells = [[cell.strip() for cell in row.split("|")[1:-1]] for row in rows]
    assert cells[1][:8] == ["features", "2", "3", "4.0", "2.00", "125.00", "0.00", "3.0"]
    assert cells[1][8:] == ["0.67", "5.0", "0.40"]
    assert cells[3] == ["whole run", "2", "", "6.0", "", "", "", "5.0", "0.60", "7.0", "0.43"]
