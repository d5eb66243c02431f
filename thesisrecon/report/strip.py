"""A page of pictures in a row: one large, to turn through, and all of them below; it needs no network."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image as PillowImage

from thesisrecon.report.drawing import embed_jpeg
from thesisrecon.report.html import page_resource, script_hashes, template_environment

LONG_SIDE_PX, QUALITY = 960, 85
"""Of the pictures on the page; the files beside it are of full size and without loss."""


def strip_page(
    title: str, frames: Sequence[tuple[str, NDArray[np.uint8]]], *, notes: Sequence[str] = ()
) -> str:
    """The page as text: ``frames`` are captions and pictures (h, w, 3); ``notes`` sentences without full
    stops.

    Raises ``ValueError`` without a picture.
    """
    if not frames:
        raise ValueError("a strip needs at least one picture")
    script = page_resource("strip.js")
    shown = [{"caption": caption, "image": _embedded(rgb)} for caption, rgb in frames]
    template = template_environment().from_string(page_resource("strip.html.j2"))
    return template.render(
        title=title,
        frames=shown,
        notes=list(notes),
        style=page_resource("style.css"),
        script=script,
        hashes=script_hashes([script]),
    )


def _embedded(rgb: NDArray[np.uint8]) -> str:
    picture = PillowImage.fromarray(rgb)
    picture.thumbnail((LONG_SIDE_PX, LONG_SIDE_PX), PillowImage.Resampling.LANCZOS)
    return embed_jpeg(picture, quality=QUALITY).uri
