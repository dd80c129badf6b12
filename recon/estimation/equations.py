"""Linear equations for a step of least squares: rows, and normal equations from which each view's own pose is eliminated.

Views don't depend on each other's poses, so each pose is eliminated by itself (Schur's complement): the system that is solved is
as small as the unknowns that all share, and its inverse is their covariance. Rows stay rows where few unknowns may be all but
undetermined, as of one pose: normal equations square the ratio of their singular values.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.estimation.levenberg_marquardt import Unreachable

Array = NDArray[np.float64]

TINY = 1e-12  # keeps a pose that nothing shows from being singular
RANK = 1e-7  # least ratio of singular values of rows


class Undetermined(ValueError):
    """Measurements that do not determine the unknowns, or contradict each other; the words tell the cause."""


class Rows(NamedTuple):
    """Equations `slopes @ step = left`, in standard deviations."""

    slopes: Array  # (m, g)
    left: Array  # (m,) measured less predicted

    def step(self, damping: float = 0.0) -> Array:
        """The step : (g,), with the diagonal of the normal equations times `1 + damping`.

        Raises
        ------
        Undetermined
            If the slopes' rank is less than g.
        """
        slopes, left = self
        if damping > 0:
            slopes = np.vstack([slopes, np.diag(np.sqrt(damping) * np.linalg.norm(slopes, axis=0))])
            left = np.append(left, np.zeros(slopes.shape[1]))
        step, _, rank, _ = np.linalg.lstsq(slopes, left, RANK)
        if rank < slopes.shape[1]:
            raise Undetermined(f"expected rows that determine {slopes.shape[1]} unknowns, found a rank of {rank}")
        return step


def eliminate(own: Array, rest: Array) -> Array:
    """Combinations : (n, k - p, q) of n groups of k rows that are free of their own p unknowns.

    own, rest : (n, k, p) of full rank, and (n, k, q), in standard deviations: the noise of the combinations has variance 1, too.
    """
    basis = np.linalg.qr(own, mode="complete")[0][..., own.shape[-1] :]
    return np.swapaxes(basis, -1, -2) @ rest


class Step(NamedTuple):
    """A step of all unknowns."""

    shared: Array  # (g,)
    own: Array  # (p, k)


class NormalEquations(NamedTuple):
    """Products of rows with themselves and with what is left: of g shared unknowns, and of k own ones of each of p views."""

    shared: Array  # (g, g)
    cross: Array  # (p, g, k)
    own: Array  # (p, k, k)
    right: Array  # (g,)
    own_right: Array  # (p, k)

    @classmethod
    def of_rows(cls, by_shared: Array, by_own: Array, left: Array) -> "NormalEquations":
        """Add up m rows of each view : (p, m, g), (p, m, k), (p, m), in standard deviations."""
        turned = np.swapaxes(by_own, 1, 2)
        flat = by_shared.reshape(-1, by_shared.shape[-1])
        own_right = (turned @ left[..., None])[..., 0]
        return cls(flat.T @ flat, np.swapaxes(by_shared, 1, 2) @ by_own, turned @ by_own, flat.T @ left.ravel(), own_right)

    def held(self, information: Array, departures: Array) -> "NormalEquations":
        """The same with shared unknowns measured once more, by an information : (g, g), `departures` : (g,) away from it."""
        return self._replace(shared=self.shared + information, right=self.right - information @ departures)

    def reduced(self) -> tuple[Array, Array]:
        """Normal equations of the shared unknowns : (g, g), (g,), the own ones eliminated."""
        return self._eliminated()[:2]

    def step(self, damping: float = 0.0) -> Step:
        """The step, with the diagonal times `1 + damping`.

        Raises
        ------
        Unreachable
            If the equations are singular.
        """
        shared = self.shared + damping * np.diag(np.diag(self.shared))
        damped = self._replace(shared=shared, own=self.own * (1 + damping * np.eye(self.own.shape[-1])))
        try:
            matrix, right, by_shared, alone = damped._eliminated()
            scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-30))  # units differ
            step = scale * np.linalg.solve(scale[:, None] * matrix * scale, scale * right)
        except np.linalg.LinAlgError as singular:
            raise Unreachable(str(singular)) from None
        return Step(step, alone - by_shared @ step)

    def _eliminated(self) -> tuple[Array, Array, Array, Array]:
        """Reduced equations : (g, g), (g,); the own unknowns' part of a shared step : (p, k, g), and their own : (p, k)."""
        p, g, k = self.cross.shape
        sides = np.concatenate([self.cross.swapaxes(1, 2), self.own_right[..., None]], axis=2)
        solved = np.linalg.solve(self.own + TINY * np.eye(k), sides)
        by_shared, alone = solved[..., :-1], solved[..., -1]
        cross = self.cross.swapaxes(0, 1).reshape(g, p * k)  # one product of two large matrices
        return self.shared - cross @ by_shared.reshape(p * k, g), self.right - cross @ alone.ravel(), by_shared, alone
