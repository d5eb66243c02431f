"""Synthetic and real test scenes with ground truth.

The names here are for studies of your own: generators of two views (:func:`make_two_views`), of two or more
views of a cloud (:func:`beside`, :func:`ahead`, :func:`make_cloud`) and of the cube of the thesis, noise, and
images with true cameras.
"""

from validation.scenes.layout import lay_out
from validation.scenes.real import Scene, read_scene, with_truth
from validation.scenes.real_pairs import camera_pair
from validation.scenes.rigs import (
    Rig,
    ahead,
    beside,
    cube_rig,
    draw_rig,
    make_cloud,
    noisy_tracks,
    projective_from_truth,
    zoomed,
)
from validation.scenes.two_views import TwoViews, make_two_views

__all__ = [
    "Rig",
    "Scene",
    "TwoViews",
    "ahead",
    "beside",
    "camera_pair",
    "cube_rig",
    "draw_rig",
    "lay_out",
    "make_cloud",
    "make_two_views",
    "noisy_tracks",
    "projective_from_truth",
    "read_scene",
    "with_truth",
    "zoomed",
]
