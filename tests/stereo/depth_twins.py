"""Plain NumPy twins of the compiled search for planes."""

import numpy as np

from thesisrecon.stereo.plane_kernels import HELD, HIDDEN, SAME_PLANE, TEXTURE, UNKNOWN


def squares(gray):
    """Levels (H, W, 4) of a pixel, its right, lower and lower right neighbours; 0 where one is unknown."""
    level = np.floor(np.clip(gray + np.float32(0.5), 1.0, 255.0))
    padded = np.pad(level, ((0, 1), (0, 1)), constant_values=np.nan)
    four = np.stack([padded[:-1, :-1], padded[:-1, 1:], padded[1:, :-1], padded[1:, 1:]], axis=-1)
    return np.where(np.isfinite(four).all(axis=-1, keepdims=True), four, 0.0)


class Setting:
    """A reference and its neighbours; places (x, y, 1) of inverse depth rho are at H (x, y, 1) + rho e."""

    def __init__(self, gray, others, H, e, offsets, likeness):
        self.gray, self.H, self.e, self.offsets, self.likeness = gray, H, e, offsets, likeness
        self.others = [squares(other) for other in others]

    def window(self, u, v):
        """Weights and levels of the samples of a window."""
        x, y = u + self.offsets[0].astype(int), v + self.offsets[1].astype(int)
        inside = (x >= 0) & (y >= 0) & (x < self.gray.shape[1]) & (y < self.gray.shape[0])
        level = self.gray[np.where(inside, y, v), np.where(inside, x, u)].astype(float)
        inside &= np.isfinite(level)
        level = np.where(inside, level, 0.0)
        apart = np.abs(level - self.gray[v, u]).clip(0, 255).astype(int)
        return np.where(inside, self.likeness[apart], 0.0).astype(float), level

    def costs(self, u, v, plane):
        """1 - weighted NCC with each neighbour, NaN where that does not hold the window."""
        weight, level = self.window(u, v)
        rho = plane[0] + self.offsets.T.astype(float) @ plane[1:]
        x = np.stack([u + self.offsets[0], v + self.offsets[1], np.ones_like(rho)], axis=1).astype(float)
        found = np.full(len(self.others), np.nan)
        for k, four in enumerate(self.others):
            q = x @ self.H[k].T + rho[:, None] * self.e[k]
            centre = self.H[k] @ (u, v, 1.0) + plane[0] * self.e[k]
            if not (q[:, 2] > 0.0).all() or not centre[2] > 0.0:
                continue
            place = q[:, :2] / q[:, 2:]
            at = np.clip(np.floor(place).astype(int), 0, np.array(four.shape[1::-1]) - 1)
            a, b, c, d = four[at[:, 1], at[:, 0]].T
            fx, fy = (place - at).T
            other = (a + fx * (b - a)) * (1.0 - fy) + (c + fx * (d - c)) * fy
            inside = (place >= 0.0).all(axis=1) & (place < np.array(four.shape[1::-1]) - 1).all(axis=1)
            held = np.where(inside & (a > 0.0), weight, 0.0)
            if held.sum() >= HELD * weight.sum():
                share = held / held.sum()
                one, two = level - share @ level, other - share @ other
                spread = (share @ one**2 + TEXTURE) * (share @ two**2 + TEXTURE)
                found[k] = max(1.0 - share @ (one * two) / np.sqrt(spread), 0.0)
        return found

    def cost(self, u, v, plane):
        """That of the two best neighbours, the second at most ``HIDDEN`` above the first."""
        found = np.sort(self.costs(u, v, plane)) if plane[0] > 0.0 else np.full(1, np.nan)
        found = np.append(found[np.isfinite(found)], [UNKNOWN, UNKNOWN])
        return found[0] + 0.5 * min(found[1] - found[0], HIDDEN) if found[0] < UNKNOWN else UNKNOWN

    def motions(self, u, v, rho):
        """Pixels (K,) that places move per unit of inverse depth."""
        q = self.H @ (u, v, 1.0) + rho * self.e
        return np.linalg.norm((self.e[:, :2] - q[:, :2] / q[:, 2:] * self.e[:, 2:]) / q[:, 2:], axis=1)

    def begin(self, planes):
        """Cost (H, W) of planes (H, W, 3)."""
        cost = np.full(self.gray.shape, UNKNOWN)
        for v, u in np.argwhere(np.isfinite(self.gray) & (planes[..., 0] > 0.0)):
            cost[v, u] = self.cost(u, v, planes[v, u].astype(float))
        return cost

    def rate(self, planes, accepted):
        """Least cost, support and slope (H, W)."""
        least, support, slope = np.full(self.gray.shape, UNKNOWN), np.zeros(self.gray.shape, int), None
        slope = np.zeros(self.gray.shape)
        for v, u in np.argwhere(np.isfinite(self.gray) & (planes[..., 0] > 0.0)):
            found = self.costs(u, v, planes[v, u].astype(float))
            good = np.nan_to_num(found, nan=UNKNOWN) <= accepted
            least[v, u] = np.nanmin(np.append(found, UNKNOWN))
            support[v, u] = good.sum()
            slope[v, u] = np.linalg.norm(self.motions(u, v, planes[v, u, 0])[good])
        return least, support, slope

    def sweep(self, planes, cost, *, step_px, settled, backward):
        """One pass over planes and costs, in place."""
        height, width = self.gray.shape
        way = -1 if backward else 1
        for v in range(height)[::way]:
            for u in range(width)[::way]:
                if np.isfinite(self.gray[v, u]) and not cost[v, u] <= settled:
                    self.improve(planes, cost, (u, v), way, step_px)

    def improve(self, planes, cost, at, way, step_px):
        """One pixel of a pass."""
        u, v = at
        reach = -self.offsets[0, 0]
        plane, least = planes[v, u].astype(float), float(cost[v, u])

        def take(trial):
            nonlocal plane, least
            tried = self.cost(u, v, trial)
            if tried < least:
                plane, least = trial, tried

        move = step_px / self.motions(u, v, plane[0]).max() if least < UNKNOWN else 0.0
        for a, b in ((u - way, v), (u, v - way)):
            if 0 <= a < planes.shape[1] and 0 <= b < planes.shape[0] and np.isfinite(planes[b, a, 0]):
                trial = planes[b, a].astype(float)
                trial[0] += (u - a) * trial[1] + (v - b) * trial[2]
                apart = np.abs(trial - plane) @ (1.0, reach, reach)
                if not apart <= SAME_PLANE * move:
                    take(trial)
        if least < UNKNOWN:
            move = step_px / self.motions(u, v, plane[0]).max()
            for k in range(6):
                take(plane + np.eye(3)[k // 2] * (1 - 2 * (k % 2)) * move / (1.0 if k < 2 else reach))
        planes[v, u], cost[v, u] = plane, least
