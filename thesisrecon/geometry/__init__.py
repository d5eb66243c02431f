"""Chapter 3: projective geometry.

Pure functions of arrays, transform or camera first: ``project(P, X)``.

===================== ============================================================================
3.2                   ``homogeneous``
3.3, 3.4, (3.1-3.15)  ``strata``: transforms of every entity, groups, invariants, conics, similarities
3.5, (3.16)-(3.27)    ``camera_matrix``: P = K [R t], projection, cheirality
3.6.1, 3.6.2, 3.6.4   ``two_view``: fundamental matrix, epipoles, homographies, residuals, canonical cameras
3.6.3                 ``three_view``: the trifocal tensor
6.3, 6.4              ``triangulation``, ``polynomial_triangulation`` (two views), resection
===================== ============================================================================
"""
