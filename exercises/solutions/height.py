"""Heights by the cross ratio."""

import numpy as np


def ratio(v, l, base, top):
    """The height times alpha, of segments (N, 2)."""
    b, t = (np.column_stack([p, np.ones(len(p))]) for p in (base, top))
    return np.linalg.norm(np.cross(b, t), axis=1) / (np.abs(b @ l) * np.linalg.norm(np.cross(v, t), axis=1))


def height(v, l, base, top, known_base, known_top, known_height):
    """Return heights (N,) of segments (N, 2)."""
    known = ratio(v, l, known_base[None], known_top[None])
    return known_height * ratio(v, l, base, top) / known
