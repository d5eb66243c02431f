"""What measures pictures."""

import numpy as np
import pytest

from thesisrecon.views.image_similarity import GREY
from validation.metrics.pictures import psnr_db, ssim


def test_psnr_is_that_of_the_mean_square():
    truth = np.zeros((4, 5, 3))
    assert psnr_db(truth, truth) == np.inf
    assert psnr_db(truth + 255.0, truth) == 0.0
    wrong = truth.copy()
    wrong[0] = 25.5
    where = np.zeros((4, 5), dtype=bool)
    where[0] = True
    assert psnr_db(wrong, truth, where=where) == pytest.approx(20.0)
    assert psnr_db(wrong, truth) == pytest.approx(20.0 + 10.0 * np.log10(4.0))


def test_similarity_of_structure_is_the_formula_of_windows():
    rng = np.random.default_rng(0)
    truth = rng.uniform(0.0, 255.0, (24, 30, 3))
    other = truth + rng.normal(0.0, 30.0, truth.shape)
    x, y = truth @ GREY, other @ GREY
    at = np.arange(-5, 6)
    w = np.exp(-0.5 * (at / 1.5) ** 2)
    w = np.outer(w, w) / w.sum() ** 2
    values = []
    for r in range(5, 19):
        for c in range(5, 25):
            a, b = x[r - 5 : r + 6, c - 5 : c + 6], y[r - 5 : r + 6, c - 5 : c + 6]
            ma, mb = (w * a).sum(), (w * b).sum()
            va, vb, vab = (w * a * a).sum() - ma**2, (w * b * b).sum() - mb**2, (w * a * b).sum() - ma * mb
            c1, c2 = 2.55**2, 7.65**2
            values.append((2 * ma * mb + c1) * (2 * vab + c2) / ((ma**2 + mb**2 + c1) * (va + vb + c2)))
    assert ssim(other, truth) == pytest.approx(np.mean(values), rel=1e-9)
    assert ssim(truth, truth) == pytest.approx(1.0)
