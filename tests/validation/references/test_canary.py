"""The questions to the reference libraries: answered as expected by those that are here, and by no others."""

from dataclasses import replace

import numpy as np
import pytest

from validation.references import canary
from validation.references.canary import QUESTIONS, ask_canary, main
from validation.references.libraries import NAMES, NoReference, load


@pytest.fixture(params=list(NAMES))
def library(request):
    try:
        load(request.param)
    except NoReference as missing:
        pytest.skip(str(missing))
    return str(request.param)


def test_the_library_keeps_its_ways(library):
    # An unexpected answer raises NoReference: that none is raised is the assertion.
    assert ask_canary(library) is None


def test_every_deviating_answer_is_reported(library, monkeypatch):
    for question in QUESTIONS[library]:
        other = replace(question, answer=np.asarray(question.answer) + max(2.0 * question.tolerance, 1e-3))
        monkeypatch.setitem(canary.QUESTIONS, library, (other,))
        with pytest.raises(NoReference) as reported:
            ask_canary(library)
        assert str(reported.value).startswith(f"{NAMES[library]} ")
        assert f" gives {question.words} as " in str(reported.value)
        assert "; this harness expects " in str(reported.value)


def test_a_missing_function_is_reported(library, monkeypatch, capsys):
    gone = replace(QUESTIONS[library][0], ask=lambda: getattr(load(library), "no_such_function"))  # noqa: B009
    monkeypatch.setitem(canary.QUESTIONS, library, (gone,))
    assert main([library]) == 3
    assert f"does not compute {gone.words}, which this harness needs" in capsys.readouterr().err


def test_quaternions_in_another_order_would_be_reported(monkeypatch):
    pycolmap = pytest.importorskip("pycolmap")
    turned = pycolmap.Rotation3d
    monkeypatch.setattr(pycolmap, "Rotation3d", lambda wxyz: turned(np.roll(wxyz, -1)))
    with pytest.raises(NoReference, match=r"^pycolmap \S+ gives the quaternion \(0, 0, 1, 0\) as"):
        ask_canary("pycolmap")


def test_a_disparity_in_pixels_would_be_reported(monkeypatch):
    pytest.importorskip("cv2")
    monkeypatch.setattr(canary, "_opencv_disparity", lambda: 4.0)
    asked = [q for q in QUESTIONS["cv2"] if "disparity" in q.words]
    monkeypatch.setitem(canary.QUESTIONS, "cv2", (replace(asked[0], ask=canary._opencv_disparity),))
    with pytest.raises(NoReference, match=r"a disparity of 4 px as 4\.; this harness expects 64"):
        ask_canary("cv2")
