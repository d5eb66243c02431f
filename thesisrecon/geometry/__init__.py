"""Chapter 3: projective geometry as pure functions of arrays.

===================== ============================================================================
section               module
===================== ============================================================================
3.2                   ``homogeneous``, ``lines_and_planes``
3.3, 3.4.1-3.4.5      ``strata`` (table of transforms, the four groups, upgrades), ``invariants``
3.4.6, (3.1)-(3.15)   ``conics``, ``absolute_conic``
3.5.1, (3.16)-(3.26)  ``camera``
3.5.2, (3.27)         ``cheirality``
3.6.1, (3.28)-(3.32)  ``homographies``
3.6.2, (3.33)-(3.35)  ``multiview``
3.6.3                 ``trifocal``, ``trifocal_linear``
3.6.4, (3.36)-(3.42)  ``homographies``, ``multiview``
6.3, 6.4              ``triangulation``, ``optimal_triangulation``, ``resection``
===================== ============================================================================

``kernels`` and ``two_view`` are compiled triangulation. ``alignment`` compares two metric models, ``raster``
resamples images.
"""
