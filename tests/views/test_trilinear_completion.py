"""What only one of two photographs shows is hidden behind what the other one shows."""

import numpy as np
import pytest

from tests.views.test_trilinear_synthesis import PAIR, SIZE, STILL, _hidden, _places, _scene
from thesisrecon.errors import StageFailure
from thesisrecon.views.trilinear_synthesis import complete_places, guess_rows
from thesisrecon.views.warping import DIRECTIONS
from thesisrecon.views.warping_kernels import distances_to_known


def _true_places():
    (_, X1), (_, X2) = _scene(*STILL), _scene(PAIR.R, PAIR.t)
    places = _places(X1, PAIR.R, PAIR.t), _places(X2, *STILL)
    return places, (_hidden(X1, PAIR.R, PAIR.t), _hidden(X2, *STILL))


@pytest.mark.parametrize("told", ["nothing", "the foreground"])
def test_hidden_pixels_are_found_out_and_take_the_background(told):
    places, hidden = _true_places()
    given = [there.copy() for there in places]
    for side in (0, 1):
        inside = np.all((places[side] > 0.0) & (places[side] < np.array(SIZE) - 1.0), axis=2)
        given[side][hidden[side]] = np.nan
        if told == "the foreground":
            # As a matcher does that fattens what is in front.
            given[side][hidden[side] & inside] = places[side][60, 80]
    complete, known = complete_places(PAIR, (given[0], given[1]), agree_px=1.5)
    for side in (0, 1):
        inside = np.all((places[side] > 0.0) & (places[side] < np.array(SIZE) - 1.0), axis=2)
        assert known[side][inside & ~hidden[side]].mean() > 0.97
        assert known[side][hidden[side]].mean() < 0.03
        off = np.linalg.norm(complete[side] - places[side], axis=2)
        assert np.isfinite(off).all()
        assert np.mean(off[hidden[side] & inside] < 2.0) > 0.9
        np.testing.assert_array_equal(complete[side][known[side]], given[side][known[side]])


def test_everything_is_believed_where_asked_to():
    places, _ = _true_places()
    complete, known = complete_places(PAIR, places, agree_px=np.inf)
    assert known[0].all()
    assert known[1].all()
    np.testing.assert_array_equal(complete[0], places[0])


def test_photographs_that_contradict_each_other_have_no_correspondence():
    places, _ = _true_places()
    with pytest.raises(StageFailure, match="no pixel of photograph 1 is known"):
        complete_places(PAIR, (places[0] + 50.0, places[1]), agree_px=1.5)


def test_the_kernel_is_its_plain_twin():
    rng = np.random.default_rng(9)
    own = rng.choice([0.1, 0.2, 0.4, np.nan], (11, 14)).astype(np.float32)
    other = rng.choice([0.15, 0.3, np.nan], (12, 13)).astype(np.float32)
    P2 = np.column_stack([np.eye(3) + 0.01 * rng.normal(size=(3, 3)), [-20.0, 3.0, 0.1]])
    distance = np.empty((len(DIRECTIONS), *own.shape), dtype=np.int16)
    distances_to_known(own, DIRECTIONS, distance)
    found = np.empty_like(own)
    guess_rows((own, other), P2, DIRECTIONS, distance, 0.05, found)
    for y, x in np.ndindex(own.shape):
        candidates = []
        for (dy, dx), n in zip(DIRECTIONS, distance[:, y, x], strict=True):
            if n < 1:
                continue
            rho = own[y + n * dy, x + n * dx]
            u, v, w = P2 @ np.array([x, y, 1.0, rho])
            j, i = int(np.rint(u / w)), int(np.rint(v / w))
            seen = other[i, j] if 0 <= i < 12 and 0 <= j < 13 else np.nan
            candidates.append((bool(w <= 0.0 or rho / w > seen + 0.05), n * n * (dy**2 + dx**2), rho))
        if np.isfinite(own[y, x]):
            assert found[y, x] == own[y, x]
        else:
            nearest = min(c[:2] for c in candidates)
            assert found[y, x] in [c[2] for c in candidates if c[:2] == nearest]
