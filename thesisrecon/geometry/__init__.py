"""Chapter 3: projective geometry.

Pure functions of arrays, transform or camera first: ``project(P, X)``.

===================== ============================================================================
3.2                   ``homogeneous``
3.3, 3.4.1-3.4.5      ``strata``: transforms of every entity, the four groups, their invariants
3.4.6, (3.1)-(3.15)   ``conics``: conics, quadrics, the absolute conic
3.5, (3.16)-(3.27)    ``camera_matrix``: P = K [R t], projection, distortion, cheirality
3.6.1, 3.6.2, 3.6.4   ``two_view``: fundamental matrix, epipoles, homographies, residuals, canonical cameras
3.6.3                 ``three_view``: the trifocal tensor
3.4.4                 ``similarity``: alignment of metric models
6.3                   ``triangulation``, ``polynomial_triangulation`` (two views)
6.4                   ``resection`` (linear, P3P), ``robust_resection``
images, meshes        ``_image_filters`` resizes images, ``_zbuffer`` renders meshes
===================== ============================================================================
"""
