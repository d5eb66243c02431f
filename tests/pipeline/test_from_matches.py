"""Matches and tracks of other programs: the same cameras from each form, and one sentence for wrong input."""

import shutil
from dataclasses import replace

import numpy as np
import PIL.Image
import pytest

import thesisrecon
from tests.conftest import refuses
from tests.pipeline.fake_stages import FakeDense
from tests.pipeline.given_scene import SIZE, given_scene, write_database
from thesisrecon import UsageError, reconstruct_from_colmap, reconstruct_from_matches, reconstruct_from_tracks
from thesisrecon.cli.commands import run_command
from thesisrecon.io._models import read_model
from thesisrecon.pipeline import stages

SCENE = given_scene()


@pytest.fixture(scope="module")
def from_rows():
    return reconstruct_from_matches(SCENE.keypoints, SCENE.matches, SCENE.sizes)


def focal_is_right(result, scene=SCENE):
    camera = result.cameras[0]
    assert len(result.cameras) == len(scene.cameras)
    assert abs(camera.K[0, 0] - scene.cameras[0].K[0, 0]) < 4 * camera.std["focal_px"]
    return camera.K[0, 0]


def test_rows_positions_tracks_and_pairs_in_the_other_order_give_the_same_cameras(from_rows):
    focal_px = focal_is_right(from_rows)
    assert from_rows.summary["trusted"]
    k = SCENE.keypoints
    positions = {(i, j): (k[i], k[j]) for i, j in SCENE.matches}
    result = reconstruct_from_matches(None, positions, SCENE.sizes)
    assert focal_is_right(result) == pytest.approx(focal_px, rel=1e-3)
    turned = {(j, i): rows[:, ::-1] for (i, j), rows in SCENE.matches.items()}
    result = reconstruct_from_matches(SCENE.keypoints, turned, SCENE.sizes)
    assert np.array_equal(result.points, from_rows.points)
    tracks = SCENE.tracks
    tracks.xy[::25] += 20.0
    result = reconstruct_from_tracks(tracks, SCENE.sizes)
    assert focal_is_right(result) == pytest.approx(from_rows.cameras[0].K[0, 0], rel=1e-2)
    assert result.tracks.n_points == 200
    # SIFT repeats a position with another orientation; both rows are matched.
    keypoints = [np.concatenate([xy, xy[:50]]) for xy in SCENE.keypoints]
    matches = {pair: np.concatenate([rows, rows[:50] + 200]) for pair, rows in SCENE.matches.items()}
    matches[0, 1] = np.concatenate([SCENE.matches[0, 1][50:], SCENE.matches[0, 1][:50] + 200])
    result = reconstruct_from_matches(keypoints, matches, SCENE.sizes)
    assert result.tracks.n_points == from_rows.tracks.n_points


def test_images_give_colours_and_other_sizes_of_work(from_rows):
    images = [np.full((480, 640, 3), 40 * i, np.uint8) for i in range(5)]
    for i, image in enumerate(images):
        image[::8] = 200
        image[0, 0] = i
    config = thesisrecon.PipelineConfig(images=thesisrecon.config.ImageOptions(max_size_px=320))
    result = reconstruct_from_matches(
        SCENE.keypoints, SCENE.matches, SCENE.sizes, images=images, config=config, until="metric"
    )
    assert result.images[0].size == (320, 240)
    assert focal_is_right(result) == pytest.approx(from_rows.cameras[0].K[0, 0], rel=1e-4)


def test_a_run_without_a_folder_holds_all_depth_maps(monkeypatch):
    monkeypatch.setattr(stages, "MAP_BYTES", 1)
    images = np.random.default_rng(0).integers(0, 256, (5, 480, 640, 3), np.uint8)
    config = thesisrecon.PipelineConfig(dense=FakeDense())
    result = reconstruct_from_matches(
        SCENE.keypoints, SCENE.matches, SCENE.sizes, images=list(images), config=config, until="dense"
    )
    assert [m.depth.shape for m in result.depth_maps] == [(480, 640)] * 5


def test_a_run_in_a_folder_is_resumed_and_other_matches_are_another_run(tmp_path):
    out = tmp_path / "out"
    reconstruct_from_matches(SCENE.keypoints, SCENE.matches, SCENE.sizes, out)
    again = reconstruct_from_matches(SCENE.keypoints, SCENE.matches, SCENE.sizes, out)
    assert "projective" in again.summary["resumed"]
    assert (out / "report.html").is_file()
    fewer = {pair: rows[20:] for pair, rows in SCENE.matches.items()}
    digests = r"the given matches \(digest \w{12}\), this run starts from the given matches \(digest \w{12}\)"
    with pytest.raises(UsageError, match=rf"it was made from {digests}\); choose another folder"):
        reconstruct_from_matches(SCENE.keypoints, fewer, SCENE.sizes, out)
    model = (tmp_path / "sparse").absolute()
    shutil.copytree(out / "sparse" / "0", model)
    with pytest.raises(UsageError, match=rf"given matches \(.*\), this run starts from {model} \("):
        reconstruct_from_colmap(model, out)
    with pytest.raises(UsageError, match=r"given matches \(.*\), this run starts from images\)"):
        thesisrecon.reconstruct([np.zeros((480, 640, 3), np.uint8)] * 5, out)


def test_a_source_that_was_moved_is_the_same_run(tmp_path, from_rows):
    thesisrecon.save(from_rows, tmp_path / "first")
    reconstruct_from_colmap(tmp_path / "first" / "sparse" / "0", tmp_path / "out")
    shutil.move(tmp_path / "first", tmp_path / "second")
    again = reconstruct_from_colmap(tmp_path / "second" / "sparse" / "0", tmp_path / "out")
    assert "projective" in again.summary["resumed"]


def moved(index, value):
    keypoints = [xy.copy() for xy in SCENE.keypoints]
    keypoints[index] = value(keypoints[index])
    return keypoints


WRONG = {
    "sizes must be": (SCENE.keypoints, SCENE.matches, [640, 480]),
    "whole numbers of pixels": (SCENE.keypoints, SCENE.matches, [(640.5, 480)] * 5),
    r"reach .* px outside 480 x 640 px: sizes are \(width": (
        SCENE.keypoints,
        SCENE.matches,
        [(480, 640)] * 5,
    ),
    "keypoints of 4 images and 5 sizes": (SCENE.keypoints[:4], SCENE.matches, SCENE.sizes),
    "finite positions": (moved(1, lambda xy: xy * np.nan), SCENE.matches, SCENE.sizes),
    r"\(N, 2\)": (moved(1, lambda xy: xy.T), SCENE.matches, SCENE.sizes),
    "two different numbers from 0 to 4": (SCENE.keypoints, {(0, 5): SCENE.matches[0, 1]}, SCENE.sizes),
    "given twice": (SCENE.keypoints, SCENE.matches | {(1, 0): SCENE.matches[0, 1]}, SCENE.sizes),
    "does not exist": (SCENE.keypoints, {(0, 1): SCENE.matches[0, 1] + 1}, SCENE.sizes),
    "whole numbers, rows": (SCENE.keypoints, {(0, 1): SCENE.matches[0, 1] + 0.5}, SCENE.sizes),
    "keypoints is None": (None, SCENE.matches, SCENE.sizes),
    "there are no matches": (SCENE.keypoints, {}, SCENE.sizes),
    "keypoints of 5 images and 3 sizes": (SCENE.keypoints, SCENE.matches, SCENE.sizes[:3]),
    "must be a table .* got a list": (SCENE.keypoints, [SCENE.matches[0, 1]], SCENE.sizes),
    "take .k.pt for k": (moved(1, lambda _: [object()] * 3), SCENE.matches, SCENE.sizes),
}


@pytest.mark.parametrize("sentence", WRONG)
def test_wrong_input_gets_one_sentence(sentence):
    refuses(UsageError, sentence, reconstruct_from_matches, *WRONG[sentence])
    right = SCENE.keypoints, SCENE.matches, SCENE.sizes
    refuses(UsageError, "needs the images", reconstruct_from_matches, *right, until="model")


def test_wrong_tracks_are_refused():
    for wrong, words in (
        (replace(SCENE.tracks, n_views=4), "there are tracks of 4 images and 5 sizes"),
        (replace(SCENE.tracks, view_index=SCENE.tracks.view_index + 1), "beyond the 5 views"),
        (replace(SCENE.tracks, xy=SCENE.tracks.xy[:9]), r"xy \(K, 2\)"),
        (SCENE.keypoints, r"must be thesisrecon.Tracks or an array of pixels \(V, N, 2\)"),
    ):
        refuses(UsageError, words, reconstruct_from_tracks, wrong, SCENE.sizes)


def test_masks_drop_matches_and_observations(tmp_path, from_rows):
    """The right third of each image is masked; there are no images."""
    mask = np.full((480, 640), 255, np.uint8)
    mask[:, 427:] = 0
    for i in range(5):
        PIL.Image.fromarray(mask).save(tmp_path / f"image-{i}.png")
    for given in (
        (reconstruct_from_matches, SCENE.keypoints, SCENE.matches),
        (reconstruct_from_tracks, SCENE.tracks),
    ):
        result = given[0](*given[1:], SCENE.sizes, masks=tmp_path)
        focal_is_right(result)
        assert 0 < len(result.points) < len(from_rows.points)
        assert max(result.observations(i).xy[:, 0].max() for i in range(5)) < 427
        assert result.summary["cameras"][0]["masked_fraction"] == pytest.approx(1 / 3, abs=0.01)
    refuses(UsageError, "no file in .* is named like an image", reconstruct_from_matches,
            SCENE.keypoints, SCENE.matches, SCENE.sizes, names="abcde", masks=tmp_path)  # fmt: skip


def database_in(folder, *, verified=True):
    return write_database(folder / "database.db", SCENE.keypoints, SCENE.matches, verified=verified)


@pytest.mark.parametrize("verified", [True, False])
def test_a_database_gives_the_same_cameras(verified, tmp_path, from_rows):
    result = reconstruct_from_colmap(database_in(tmp_path, verified=verified))
    assert list(result.cameras) == [f"{i}.jpg" for i in range(5, 10)]
    # Keypoints are stored in single precision.
    assert result.cameras["9.jpg"].K[0, 0] == pytest.approx(from_rows.cameras[0].K[0, 0], rel=1e-3)


def test_the_command_reads_a_database_and_the_sparse_model_of_a_run(tmp_path, capsys):
    database = database_in(tmp_path)
    assert run_command(["reconstruct", "--from", str(database), "-o", str(tmp_path / "first")]) == 0
    assert "5 of 5 images registered" in capsys.readouterr().out
    sparse = str(tmp_path / "first" / "sparse" / "0")
    assert run_command(["reconstruct", "--from", sparse, "-o", str(tmp_path / "second")]) == 0
    one, two = (thesisrecon.load(tmp_path / name).cameras["7.jpg"].K[0, 0] for name in ("first", "second"))
    assert two == pytest.approx(one, rel=5e-3)
    (tmp_path / "text.db").write_text("no database")
    refuses(UsageError, "is not a valid COLMAP database", reconstruct_from_colmap, tmp_path / "text.db")
    refuses(UsageError, "there is no COLMAP database or model", reconstruct_from_colmap, tmp_path / "none.db")


@pytest.mark.parametrize("orientation", [3, 6])
def test_images_of_colmap_are_used_as_stored(tmp_path, from_rows, orientation):
    """COLMAP ignores the EXIF rotation; a run from its matches does so too, and says it to the export."""
    database, exif = (database_in(tmp_path), PIL.Image.Exif())
    exif[0x0112] = orientation
    pixels = np.zeros((480, 640, 3), np.uint8)
    pixels[:240, :, 0], pixels[240:, :, 1] = 200, 200
    (tmp_path / "images").mkdir()
    for i in range(5, 10):
        pixels[:8] = i
        PIL.Image.fromarray(pixels).save(tmp_path / "images" / f"{i}.jpg", exif=exif, quality=95)
    thesisrecon.save(from_rows, tmp_path / "own")
    result = reconstruct_from_colmap(database, tmp_path / "out", images=tmp_path / "images", until="metric")
    assert (result.images[0].rgb[100].argmax(axis=1) == 0).all()
    reports = {
        name: read_model(tmp_path / name).as_stored for name in ("own", "own/sparse/0", "out", "out/sparse/0")
    }
    assert reports == {"own": False, "own/sparse/0": False, "out": True, "out/sparse/0": True}
    for cameras in (result.cameras, thesisrecon.load(tmp_path / "out").cameras):
        assert cameras["7.jpg"].as_stored
    assert not from_rows.cameras[0].as_stored
    again = {"images": tmp_path / "images", "until": "metric"}
    assert (reconstruct_from_colmap(tmp_path / "out", **again).images[0].rgb[100].argmax(axis=1) == 0).all()
    exported = (
        thesisrecon.export(result, tmp_path / "export", to="nerfstudio").file.parent / "images" / "7.jpg"
    )
    with PIL.Image.open(exported) as image:
        assert np.asarray(image)[100, 320].argmax() == 0


def with_few_matches(index):
    """Matches in which pairs with one image have too few to be accepted."""
    few = {pair: rows[30 * sum(pair) % 100 :][:40] for pair, rows in SCENE.matches.items()}
    return {pair: few[pair] if index in pair else rows for pair, rows in SCENE.matches.items()}


def test_an_image_of_rejected_pairs_joins_the_finished_model(tmp_path):
    matches = with_few_matches(4)
    result = reconstruct_from_matches(SCENE.keypoints, matches, SCENE.sizes, tmp_path)
    assert not any(pair.accepted for pair in result.pairs if pair.j == 4)
    assert not result.projective.registered[4]
    assert focal_is_right(result)
    found, true = ([c.R for c in cameras] for cameras in (result.cameras.values(), SCENE.cameras))
    difference = np.degrees(np.arccos((np.trace(found[0] @ found[4].T @ true[4] @ true[0].T) - 1) / 2))
    assert difference < 0.3
    loaded = thesisrecon.load(tmp_path)
    assert np.array_equal(loaded.points, result.points)
    again = reconstruct_from_matches(SCENE.keypoints, matches, SCENE.sizes, tmp_path)
    assert "metric" in again.summary["resumed"]


def test_an_image_of_another_scene_does_not_join():
    keypoints, rng = list(SCENE.keypoints), np.random.default_rng(1)
    keypoints[4] = rng.uniform(0, SIZE, keypoints[4].shape)
    result = reconstruct_from_matches(keypoints, with_few_matches(4), SCENE.sizes)
    assert list(result.metric.reconstruction.registered) == [True] * 4 + [False]


def test_corrected_sizes_are_used_by_a_repeated_run(tmp_path):
    given = {"out": tmp_path, "until": "projective"}
    doubled = [(2 * width, 2 * height) for width, height in SCENE.sizes]
    for sizes in (SCENE.sizes, doubled):
        result = reconstruct_from_matches(SCENE.keypoints, SCENE.matches, sizes, **given, overwrite=True)
        assert result.projective.sizes.tolist() == [list(size) for size in sizes]
