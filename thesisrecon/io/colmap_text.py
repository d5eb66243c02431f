"""COLMAP's text files: lines of a model, and a model of lines. Numbers have 17 digits: every bit is kept."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thesisrecon.io.colmap_model import (
    TRACK_ENTRY,
    ColmapCamera,
    ColmapImage,
    ColmapModel,
    ColmapPoints,
    broken_file,
    points_of_records,
)
from thesisrecon.io.files import shortened


def _numbers(values: NDArray[np.float64] | tuple[float, ...]) -> str:
    return " ".join(format(value, ".17g") for value in values)


def _text(header: str, lines: list[str]) -> bytes:
    return "".join(f"{line}\n" for line in (*header.splitlines(), *lines)).encode("utf-8", "surrogateescape")


def _print_cameras(model: ColmapModel) -> bytes:
    header = (
        "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
    )
    lines = [f"{c.camera_id} {c.model} {c.width} {c.height} {_numbers(c.params)}" for c in model.cameras]
    return _text(f"{header}# Number of cameras: {len(lines)}", lines)


def _print_images(model: ColmapModel) -> bytes:
    header = (
        "# Image list with two lines of data per image:\n"
        "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n"
        "#   POINTS2D[] as (X, Y, POINT3D_ID)\n"
    )
    lines = []
    for image in model.images:
        pose = f"{_numbers(image.quaternion_wxyz)} {_numbers(image.translation)}"
        lines.append(f"{image.image_id} {pose} {image.camera_id} {image.name}")
        observations = zip(image.xy.tolist(), image.point_ids.tolist(), strict=True)
        lines.append(" ".join(f"{_numbers(tuple(xy))} {owner}" for xy, owner in observations))
    return _text(f"{header}# Number of images: {len(model.images)}", lines)


def _print_points(model: ColmapModel) -> bytes:
    points = model.points
    header = (
        "# 3D point list with one line of data per point:\n"
        "#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n"
    )
    entries = [f"{i} {k}" for i, k in zip(points.track_image.tolist(), points.track_xy.tolist(), strict=True)]
    starts, lines = points.track_start.tolist(), []
    for n, number in enumerate(points.ids.tolist()):
        rgb = " ".join(map(str, points.rgb[n].tolist()))
        track = " ".join(entries[starts[n] : starts[n + 1]])
        lines.append(
            f"{number} {_numbers(points.xyz[n])} {rgb} {_numbers((float(points.error[n]),))} {track}"
        )
    return _text(f"{header}# Number of points: {len(lines)}", lines)


def _print_rigs(model: ColmapModel) -> bytes:
    header = "# Rig list, one line each:\n#   RIG_ID, NUM_SENSORS, REF_SENSOR_TYPE, REF_SENSOR_ID, SENSORS[]"
    return _text(header, [f"{camera.camera_id} 1 CAMERA {camera.camera_id}" for camera in model.cameras])


def _print_frames(model: ColmapModel) -> bytes:
    header = (
        "# Frame list, one line each:\n#   FRAME_ID, RIG_ID, RIG_FROM_WORLD[QW, QX, QY, QZ, TX, TY, TZ], "
        "NUM_DATA_IDS, DATA_IDS[] as (SENSOR_TYPE, SENSOR_ID, DATA_ID)"
    )
    lines = [
        f"{image.image_id} {image.camera_id} {_numbers(image.quaternion_wxyz)} {_numbers(image.translation)}"
        f" 1 CAMERA {image.camera_id} {image.image_id}"
        for image in model.images
    ]
    return _text(header, lines)


ENCODERS: dict[str, Callable[[ColmapModel], bytes]] = {
    "rigs": _print_rigs,
    "cameras": _print_cameras,
    "frames": _print_frames,
    "images": _print_images,
    "points3D": _print_points,
}


def _lines(data: bytes) -> Iterator[str]:
    return iter(data.decode("utf-8", "surrogateescape").split("\n"))


def _records(lines: Iterator[str]) -> Iterator[str]:
    return (line.strip() for line in lines if line.strip() and not line.startswith("#"))


def read_cameras(data: bytes, path: Path) -> tuple[ColmapCamera, ...]:
    cameras = []
    for line in _records(_lines(data)):
        words = line.split()
        try:
            number, width, height = int(words[0]), int(words[2]), int(words[3])
            cameras.append(ColmapCamera(number, words[1], width, height, tuple(map(float, words[4:]))))
        except (ValueError, IndexError) as error:
            raise broken_file(path, f"the line {_short(line)} is no camera") from error
    return tuple(cameras)


def read_images(data: bytes, path: Path) -> tuple[ColmapImage, ...]:
    images, lines = [], _lines(data)
    for line in _records(lines):
        words = line.split(maxsplit=9)
        # An image without image points has an empty second line, so it must not be skipped like other blanks.
        second = next(lines, "").split()
        try:
            pose = np.array(words[1:8], dtype=np.float64)
            xy = np.array([second[0::3], second[1::3]], dtype=np.float64).T.reshape(-1, 2)
            owners = np.array([int(word) for word in second[2::3]], dtype=np.int64)
            image = ColmapImage(int(words[0]), pose[:4], pose[4:], int(words[8]), words[9], xy, owners)
        except (ValueError, IndexError, OverflowError) as error:
            raise broken_file(path, f"the lines from {_short(line)} on are no image") from error
        images.append(image)
    return tuple(images)


def read_points(data: bytes, path: Path) -> ColmapPoints:
    heads: list[tuple[int | float, ...]] = []
    entries: list[tuple[int, int]] = []
    for line in _records(_lines(data)):
        words = line.split()
        try:
            track = [int(word) for word in words[8:]]
            pairs = list(zip(track[0::2], track[1::2], strict=True))
            rgb = [int(word) for word in words[4:7]]
            head = (int(words[0]), *map(float, words[1:4]), *rgb, float(words[7]), len(pairs))
        except (ValueError, IndexError) as error:
            raise broken_file(path, f"the line {_short(line)} is no point") from error
        if (
            head[0] < 0
            or not all(0 <= value < 256 for value in rgb)
            or not all(0 <= k < 2**32 for k in track)
        ):
            raise broken_file(path, f"the line {_short(line)} holds a number out of range")
        heads.append(head)
        entries.extend(pairs)
    return points_of_records(heads, np.array(entries, dtype=TRACK_ENTRY), path)


def _short(line: str) -> str:
    return repr(shortened(line))
