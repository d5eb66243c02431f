"""The picture of the first page: input images, cameras with points, and the model of the courtyard."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image, ImageDraw

from _ext.code import ROOT

IMAGES = ROOT / "fixtures" / "courtyard" / "images"
HEIGHT, GAP = 420, 12
WHITE = (255, 255, 255)


def draw_input() -> Image.Image:
    """Four images in a 2 x 2 grid."""
    images = sorted(IMAGES.glob("*.jpg"))
    chosen = [images[round(k * (len(images) - 1) / 3)] for k in range(4)]
    height = (HEIGHT - GAP) // 2
    tiles = [Image.open(path).convert("RGB") for path in chosen]
    width = round(height * tiles[0].width / tiles[0].height)
    panel = Image.new("RGB", (2 * width + GAP, HEIGHT), WHITE)
    for k, tile in enumerate(tiles):
        panel.paste(tile.resize((width, height)), ((k % 2) * (width + GAP), (k // 2) * (height + GAP)))
    return panel


def scene_panel(run: Path, width: int) -> Image.Image:
    """Points and camera pyramids, seen from above the cameras and behind them."""
    cloud = trimesh.load(run / "points.ply")
    X, colours = np.asarray(cloud.vertices), np.asarray(cloud.colors)[:, :3]
    cameras = json.loads((run / "cameras.json").read_text(encoding="utf-8"))["cameras"]
    R = np.array([c["R"] for c in cameras])
    centres = -np.einsum("vji,vj->vi", R, np.array([c["t"] for c in cameras]))
    middle = np.median(X, axis=0)
    distances = np.linalg.norm(X - middle, axis=1)
    near = distances < 3.0 * np.median(distances)
    X, colours = X[near], colours[near]
    up = -R[:, 1].mean(axis=0)
    back = centres.mean(axis=0) - middle
    eye = middle + 2.4 * back + 1.5 * np.linalg.norm(back) * up / np.linalg.norm(up)
    z = (middle - eye) / np.linalg.norm(middle - eye)
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    axes = np.stack([x, np.cross(z, x), z])

    def project(points: np.ndarray) -> np.ndarray:
        seen = (points - eye) @ axes.T
        return np.column_stack(
            [
                width / 2 + 1.05 * width * seen[:, 0] / seen[:, 2],
                HEIGHT / 2 + 1.05 * width * seen[:, 1] / seen[:, 2],
            ]
        )

    panel = Image.new("RGB", (width, HEIGHT), WHITE)
    draw = ImageDraw.Draw(panel)
    order = np.argsort(-((X - eye) @ z))
    for (u, v), colour in zip(project(X[order]), colours[order], strict=True):
        draw.rectangle((u - 0.8, v - 0.8, u + 0.8, v + 0.8), fill=tuple(int(c) for c in colour))
    size = 0.12 * np.linalg.norm(back)
    for camera, rotation, centre in zip(cameras, R, centres, strict=True):
        w, h = camera["width"] / camera["K"][0][0] / 2, camera["height"] / camera["K"][1][1] / 2
        rays = np.array([[-w, -h, 1.0], [w, -h, 1.0], [w, h, 1.0], [-w, h, 1.0]]) * size
        corners = project(centre + rays @ rotation)
        tip = project(centre[None])[0]
        for k in range(4):
            draw.line([tuple(tip), tuple(corners[k])], fill=(200, 40, 30), width=1)
            draw.line([tuple(corners[k]), tuple(corners[(k + 1) % 4])], fill=(200, 40, 30), width=1)
    return panel


def draw_overview(path: Path) -> None:
    """Reconstruct the six images and write the three panels side by side."""
    import thesisrecon

    with tempfile.TemporaryDirectory() as folder:
        result = thesisrecon.reconstruct(IMAGES, folder, max_size=480, until="model")
        scene = scene_panel(Path(folder), 560)
    cameras = list(result.cameras.values())
    middle = cameras[len(cameras) // 2]
    pinhole = thesisrecon.Camera(middle.K, middle.R, middle.t, middle.size)
    view = thesisrecon.render(result.mesh, pinhole.scaled(560 / middle.size[0]))
    frame = Image.fromarray(np.where(view.valid[..., None], view.color, 255).astype(np.uint8))
    frame = frame.resize((round(HEIGHT * frame.width / frame.height), HEIGHT))
    panels = [draw_input(), scene, frame]
    picture = Image.new("RGB", (sum(p.width for p in panels) + GAP * (len(panels) - 1), HEIGHT), WHITE)
    at = 0
    for panel in panels:
        picture.paste(panel, (at, 0))
        at += panel.width + GAP
    picture.save(path, quality=82)
