"""The verdict on the motion in words: what was found, what it means, what to do.

Clauses without a capital or a full stop, as all doubts are: the page and the summary make sentences of them.
"""

from __future__ import annotations

from collections.abc import Mapping

from thesisrecon.selfcalibration import critical_motions as critical
from thesisrecon.selfcalibration.limits import LEAST_MOVE, MAX_FOCAL_STD, MIN_SIGNIFICANCE, MOST_NOISE

_FOUND: Mapping[str, str] = {
    critical.PLANE: (
        "the points lie in one plane up to {scene_thickness:.1%} of its width: a planar scene, which leaves "
        "the "
        "cameras hardly determined"
    ),
    critical.ROTATION: (
        "the camera turned about one point (it moved by {travel_over_distance:.1%} of the distance to the "
        "scene): close to a pure rotation, which tells the focal length but hardly any depth"
    ),
    critical.TRANSLATION: (
        "the camera moved and hardly turned (by {largest_turn_deg:.1f} degrees at most): close to a pure "
        "translation, which leaves the focal length open"
    ),
    critical.OPTICAL_AXIS: (
        "the camera turned about its optical axis only, always looking in one direction: this leaves the "
        "focal "
        "length open, as a pure translation does"
    ),
    critical.TURNTABLE: (
        "all views turn about one axis (to within {axis_spread_deg:.1f} degrees), as on a turntable: this "
        "leaves "
        "the scale along the axis open unless the shape of the pixels is known"
    ),
    critical.PLANAR: (
        "the camera moved in a plane and turned about one direction (to within {axis_spread_deg:.1f} "
        "degrees), "
        "a planar motion: this leaves the scale across the plane open unless the shape of the pixels is known"
    ),
    critical.PARALLEL_AXES: (
        "all rotations have parallel axes (to within {axis_spread_deg:.1f} degrees): this leaves the scale "
        "along "
        "the axes open unless the shape of the pixels is known"
    ),
}
_FOUND_WITHOUT_AN_ANSWER: Mapping[str, str] = {
    critical.TRANSLATION: (
        "the projective cameras fit a camera that moved without turning, a pure translation, which leaves "
        "the "
        "focal length open (the picture of infinity moves by {image_shift:.1%} of the image)"
    ),
    critical.OPTICAL_AXIS: (
        "the projective cameras fit a camera that turned about its optical axis only, which leaves the focal "
        "length open (the picture of infinity moves by {image_shift_beyond_roll:.1%} of the image)"
    ),
}
_TURN_MORE = "turn the camera by 10 degrees and more between photographs, about the vertical and sideways"
_ADVICE: Mapping[str, str] = {
    critical.PLANE: "have things at different depths in the picture",
    critical.ROTATION: "walk around the scene between photographs",
    critical.TRANSLATION: _TURN_MORE,
    critical.OPTICAL_AXIS: "point the camera in different directions",
    critical.TURNTABLE: "take some photographs from higher or lower, or with the camera turned on its side",
    critical.PLANAR: "take some photographs from higher or lower, or with the camera turned on its side",
    critical.PARALLEL_AXES: "tilt the camera up and down too, or turn it on its side",
}
_FOCAL_SETTLES = (_TURN_MORE, _ADVICE[critical.OPTICAL_AXIS])
_SHAPE_SETTLES = (critical.TURNTABLE, critical.PLANAR, critical.PARALLEL_AXES)


def motion_sentences(
    motion: str, evidence: Mapping[str, float], *, identifiable: bool, focal_std: float
) -> tuple[str, ...]:
    """What a person is told of a verdict; empty where there is nothing to say (a general motion that
    determines all). ``focal_std`` is the largest relative deviation of the focal lengths that were given, inf
    where one was not."""
    is_critical = bool(motion) and evidence["nearness"] < 1.0
    answered = "focal_std_rel" in evidence
    told = []
    if evidence["spare_equations"] < 0:
        told.append(
            f"the photographs are too few for so little that is known of the cameras: "
            f"{-evidence['spare_equations']:.0f} equations are missing; add photographs, or let them share "
            "one camera"
        )
    if is_critical:
        found = (_FOUND if answered else _FOUND_WITHOUT_AN_ANSWER)[motion]
        told.append(found.format(**evidence))
    if _bent(evidence):
        told.append(
            f"cameras as they are said to be explain the photographs with "
            f"{evidence['noise_over_projective']:.1f} times the noise of projective ones: photographs were "
            "zoomed or cropped one by one, or belong to other cameras; let every photograph have its own "
            "(cameras = per-image)"
        )
    if identifiable:
        return (*told, *_what_holds(motion, evidence)) if is_critical else tuple(told)
    return (*told, *_what_fails(motion, evidence, is_critical, focal_std))


def _what_holds(motion: str, evidence: Mapping[str, float]) -> list[str]:
    std, alone = evidence["focal_std_rel_median"], evidence["focal_std_rel_free"]
    if motion in _SHAPE_SETTLES and alone > 2.0 * std:
        return [
            f"square pixels and a principal point near the middle of the image settle it if the cameras are "
            f"what they are said to be: the focal length is known to {_percent(std)} with them and to "
            f"{_percent(alone)} without; to rest on less, "
            f"{_ADVICE[motion]}"
        ]
    if motion in (critical.PLANE, critical.ROTATION):
        return [
            f"the focal length is known to {_percent(std)} if the cameras are what they are said to be; for "
            f"depths that hold, {_ADVICE[motion]}"
        ]
    return [
        f"if the cameras are what they are said to be, what departs from it fixes the focal length to "
        f"{_percent(std)}"
    ]


def _what_fails(motion: str, evidence: Mapping[str, float], is_critical: bool, focal_std: float) -> list[str]:
    advice = _ADVICE.get(motion, _TURN_MORE) if is_critical else _TURN_MORE
    if advice in _FOCAL_SETTLES and focal_std > 0.0:
        given = " more exactly" if focal_std < float("inf") else ""
        advice += f", or give the focal length{given}"
    if "focal_std_rel" not in evidence:
        return [advice]
    std = evidence["focal_std_rel_median"]
    if evidence["turn_significance"] < MIN_SIGNIFICANCE and std < MAX_FOCAL_STD:
        return [f"the turns cannot be told from noise, and no focal length can be had from them; {advice}"]
    if evidence["image_shift_beyond_roll"] < LEAST_MOVE and std < MAX_FOCAL_STD:
        return [
            f"the turns move the picture by {evidence['image_shift_beyond_roll']:.2%} of its width, as "
            f"little as what a lens model leaves out, and no focal length can be had from them; {advice}"
        ]
    if std >= MAX_FOCAL_STD:
        return [f"the cameras fix the focal length only to {_percent(std)}; {advice}"]
    # No turn of the camera mends cameras that are not what they are said to be.
    return [] if _bent(evidence) else [advice]


def _bent(evidence: Mapping[str, float]) -> bool:
    return evidence.get("noise_over_projective", 0.0) >= MOST_NOISE


def _percent(share: float) -> str:
    if share < 0.001:
        return "better than 0.1 %"
    return f"{100.0 * share:.1f} %" if share < 0.1 else f"{100.0 * min(share, 9.99):.0f} %"
