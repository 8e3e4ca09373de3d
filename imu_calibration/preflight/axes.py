"""Assignment of axes: the exchange of axes and signs that is closest to a matrix between two frames."""

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

CLEAR = 0.8
"""Agreement from which on an exchange of axes describes the matrix."""
POOR = 0.6
"""Agreement of the axes as they are below which they are wrong; a turn by 60 degrees has 0.67."""
TIE = 0.05


def signed_permutations() -> np.ndarray:
    """Return the 48 matrices that exchange axes and signs, the identity first, then by number of changes; shape (48, 3, 3)."""
    found = [np.eye(3)[list(order)] * np.array(signs)[:, None] for order in permutations(range(3)) for signs in product((1.0, -1.0),
                                                                                                                        repeat=3)]
    return np.array(sorted(found, key=lambda matrix: (matrix != np.eye(3)).any(axis=1).sum()))


@dataclass(frozen=True, eq=False)
class AxisMatch:
    """Assignment of measured axes to the axes of a reference."""

    matrix: np.ndarray
    """Closest signed permutation in ``measured = scale * matrix @ reference``, shape (3, 3)."""
    agreement: float
    """1: exactly as `matrix`."""
    as_they_are: float
    """1: every axis is that of the reference; -1: all turned round."""
    turned: bool
    """Whether a rotation explains it."""
    mirrored: bool
    """Whether a reflection explains it; with few turns both may."""

    @property
    def wrong(self) -> bool:
        """Return whether the axes differ from those of the reference."""
        return self.as_they_are < POOR

    def exchanges(self, seen: np.ndarray = np.eye(3)) -> list[tuple[int, int, float]]:
        """Return (measured axis, reference axis, sign) of each wrong axis, for the reference axes with motion."""
        found = []
        for j in np.flatnonzero(np.diag(seen) > 0.5):
            i = int(np.argmax(np.abs(self.matrix[:, j])))
            if i != j or self.matrix[i, j] < 0:
                found.append((i, int(j), float(self.matrix[i, j])))
        return sorted(found)


def match_axes(matrix: np.ndarray, seen: np.ndarray = np.eye(3)) -> AxisMatch:
    """
    Return the `AxisMatch` of ``measured = matrix @ reference``.

    Parameters
    ----------
    matrix : array, shape (3, 3)
        Up to a common positive factor; only ``matrix @ seen`` is used.
    seen : array, shape (3, 3)
        Projector on the directions in which the reference moved.

    """
    inside = matrix @ seen
    scale = np.sqrt((inside**2).sum() / np.trace(seen))
    candidates = signed_permutations()
    scores = np.einsum('kij,ij->k', candidates, inside) / (scale * np.trace(seen))
    best = scores.max()
    near = scores >= best - TIE
    proper = np.linalg.det(candidates) > 0
    return AxisMatch(candidates[np.argmax(near)], float(best), float(scores[0]), bool((near & proper).any()), bool((near & ~proper).any()))
