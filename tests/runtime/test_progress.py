"""Progress without a terminal: a line when a stage is done, and at times in between."""

from thesisrecon.runtime import _progress


def test_a_stage_is_one_line_and_a_long_one_says_where_it_is(monkeypatch):
    now, lines = [0.0], list[str]()
    monkeypatch.setattr(_progress.time, "monotonic", lambda: now[0])
    update = _progress.print_stages(lines.append)
    for done in [*range(11), 10]:
        update("features", done, 10)
        now[0] += 0.1
    for done in range(3):
        update("dense", done, 2)
        now[0] += 40.0
    assert lines == ["corners: 10 of 10, 1 s\n", "depth maps: 1 of 2, 40 s\n", "depth maps: 2 of 2, 80 s\n"]
