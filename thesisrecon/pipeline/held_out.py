"""How like an unseen photograph the model is: one photograph gives no texture and is compared with it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera import camera_centre
from thesisrecon.geometry.pinhole import PinholeCamera
from thesisrecon.types import HeldOut, PinholeView, TexturedMesh
from thesisrecon.views import render
from thesisrecon.views.likeness import exposed_alike, psnr_db, ssim, whole_pixels

FEWEST_VIEWS = 3
"""With fewer, what the photograph left out shows may be seen by nobody else."""


def middle_view(views: Sequence[PinholeView]) -> PinholeView:
    """The view whose camera is nearest to all the others: what it shows, others see too."""
    C = np.array([camera_centre(view.P) for view in views])
    centres = C[:, :3] / C[:, 3:]
    apart = np.linalg.norm(centres[:, None] - centres[None], axis=2).sum(axis=1)
    return views[int(np.argmin(apart))]


def compare_held_out(
    mesh: TexturedMesh,
    views: Sequence[PinholeView],
    color: Callable[[int], TexturedMesh],
    *,
    threads: int = 1,
) -> HeldOut | None:
    """The middle view beside the model that ``color`` (number of a view) paints without it.

    The picture of the model is made as bright as the photograph, one factor a channel. None where there are
    too few views, or the camera sees nothing of the model.
    """
    if len(views) < FEWEST_VIEWS or not len(mesh.faces):
        return None
    view = middle_view(views)
    try:
        painted = color(view.view)
    except StageFailure:
        return None
    height, width = view.rgb.shape[:2]
    rendered = render(painted, PinholeCamera.from_matrix(view.P, (width, height)), threads=threads)
    compared = whole_pixels(rendered) & view.seen
    if not compared.any():
        return None
    picture = exposed_alike(view.rgb, rendered.color, compared)
    return HeldOut(
        view.view,
        view.rgb,
        picture,
        compared,
        psnr_db(view.rgb, picture, compared),
        ssim(view.rgb, picture, compared),
    )
