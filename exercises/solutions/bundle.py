"""Bundle adjustment with a general minimiser."""

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation


def bundle(K, r, t, X, xy):
    """Return r, t and X of least reprojection error."""
    cuts = [len(r), 2 * len(r)]

    def residuals(p):
        r, t, X = np.split(p.reshape(-1, 3), cuts)
        R = Rotation.from_rotvec(r).as_matrix()
        x = (X @ R.transpose(0, 2, 1) + t[:, None]) @ K.T
        return (x[..., :2] / x[..., 2:] - xy).ravel()

    found = least_squares(residuals, np.vstack([r, t, X]).ravel(), x_scale="jac")
    r_best, t_best, X_best = np.split(found.x.reshape(-1, 3), cuts)
    return r_best, t_best, X_best
