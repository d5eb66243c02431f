from __future__ import annotations

import numpy as np
import pytest
from scipy.special import erf

from tests.textures import photograph, texture
from thesisrecon.features import HarrisCorners, MultiScaleCorners
from thesisrecon.types import Image

VARIANTS = [HarrisCorners(), MultiScaleCorners()]
Variant = HarrisCorners | MultiScaleCorners


def chessboard(dx: float, dy: float) -> Image:
    """Four quadrants meeting at (60 + dx, 50 + dy); an edge is the integral of a Gaussian of sigma 0.4."""
    x, y = np.arange(120) - 60 - dx, np.arange(100) - 50 - dy
    return photograph(128 + 90 * erf(x / 0.57)[None] * erf(y / 0.57)[:, None])


@pytest.mark.parametrize("variant", [HarrisCorners(), MultiScaleCorners(upsample_below_px=0)])
@pytest.mark.parametrize(("dx", "dy"), [(0.0, 0.0), (0.3, -0.2), (-0.45, 0.4)])
def test_a_corner_is_found_between_the_pixels(variant: Variant, dx: float, dy: float) -> None:
    features = variant.detect(chessboard(dx, dy))
    distance = np.linalg.norm(features.xy - (60 + dx, 50 + dy), axis=1)
    assert distance.min() < 0.25


@pytest.mark.parametrize("variant", VARIANTS)
def test_corners_are_sorted_inside_and_the_same_each_time(variant: Variant) -> None:
    image = photograph(texture(200, 260))
    features, again = variant.detect(image), variant.detect(image)
    assert len(features.xy) > 300
    assert (np.diff(features.response) <= 0).all()
    assert (features.xy >= 0).all()
    assert (features.xy <= (259, 199)).all()
    assert features.xy.dtype == np.float64
    assert features.scale.dtype == features.response.dtype == np.float32
    assert np.array_equal(features.xy, again.xy)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("size", [(1, 1), (2, 3), (9, 9), (20, 20), (5, 400), (64, 48)])
@pytest.mark.parametrize("kind", ["blank", "noise"])
def test_tiny_blank_and_noisy_images_do_no_harm(variant: Variant, size: tuple[int, int], kind: str) -> None:
    rng = np.random.default_rng(0)
    gray = np.full(size, 77.0) if kind == "blank" else rng.uniform(0, 255, size)
    features = variant.detect(photograph(gray))
    assert len(features.xy) == len(features.scale) == len(features.response)
    assert np.isfinite(features.xy).all()
    if kind == "blank":
        assert len(features.xy) == 0


def test_thesis_corners_keep_their_distance_and_their_number() -> None:
    features = HarrisCorners(max_corners=150, spacing_rel=0.02).detect(photograph(texture(300, 400)))
    distance = np.linalg.norm(features.xy[:, None] - features.xy[None], axis=2) + 1e9 * np.eye(
        len(features.xy)
    )
    assert len(features.xy) == 150
    assert distance.min() >= 0.02 * 400


def test_corners_cover_the_image_though_one_side_is_faint() -> None:
    gray = texture(400, 1100)
    gray[:, 550:] = 128 + 0.15 * (gray[:, 550:] - 128)
    features = MultiScaleCorners(full_corners=600, half_corners=300).detect(photograph(gray))
    assert (features.xy[:, 0] > 560).mean() > 0.1


@pytest.mark.parametrize(("width", "scales"), [(420, {0.5, 1.0}), (1040, {1.0, 2.0})])
def test_two_sizes_and_seeds_twice_in_the_pixels_of_the_photograph(width: int, scales: set[float]) -> None:
    features = MultiScaleCorners().detect(photograph(texture(300, width)))
    assert set(features.scale.tolist()) == scales
    seeds = features.seeds
    assert seeds is not None
    assert seeds.patches.dtype == np.float32
    assert np.abs(seeds.patches.sum(axis=1)).max() < 1e-3
    assert np.abs(np.linalg.norm(seeds.patches, axis=1) - 1).max() < 1e-4
    assert (seeds.angle == 0).mean() == pytest.approx(0.5, abs=0.01)
    assert (seeds.xy <= (width - 1, 299)).all()


def test_turned_patches_turn_with_the_photograph() -> None:
    gray = texture(301, 301, 8)
    one = MultiScaleCorners().detect(photograph(gray)).seeds
    two = MultiScaleCorners().detect(photograph(np.rot90(gray))).seeds
    assert one is not None
    assert two is not None
    first, second = one.angle != 0, two.angle != 0
    # np.rot90 takes pixel (x, y) to (y, width - 1 - x).
    moved = np.stack([one.xy[first, 1], 300 - one.xy[first, 0]], 1)
    agreement = []
    for n in range(0, len(moved), 7):
        distance = np.linalg.norm(two.xy[second] - moved[n], axis=1) + np.abs(
            two.scale[second] - one.scale[first][n]
        )
        m = int(np.argmin(distance))
        if distance[m] < 0.2:
            agreement.append(float(one.patches[first][n] @ two.patches[second][m]))
    assert len(agreement) > 50
    assert np.median(agreement) > 0.95
