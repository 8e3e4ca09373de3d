"""Appearance of a `Coverage` in every viewer: radius and colours, size of a cell, the line of text."""

from collections.abc import Iterator

import numpy as np

from imu_calibration.calibration.coverage import DIRECTIONS, ENOUGH, Coverage

RADIUS = 0.5
"""Of the sphere, m; the picture has no scale of its own but that of the arms, which are drawn larger."""
ARMS_TIMES = 10.0
"""Arms are millimetres."""
WANTED, SEEN, DONE, ARROW, NOW, WHITE = ((0.95, 0.55, 0.1), (0.25, 0.6, 0.95), (0.2, 0.75, 0.3), (0.9, 0.1, 0.5), (0.5, 0.5, 0.6),
                                         (0.9, 0.9, 0.9))
TINY = 0.03


def cells_of(coverage: Coverage) -> Iterator[tuple[np.ndarray, tuple[float, ...], float]]:
    """Yield (place, colour, diameter) of each cell: orange and large where a rest is still worth having, green and small where not."""
    most = max(float(coverage.worth.max()), ENOUGH)
    for direction, worth in zip(DIRECTIONS, coverage.worth, strict=True):
        share = 0.0 if coverage.done or worth < ENOUGH else float(worth) / most
        yield RADIUS * direction, tuple(share * wanted + (1 - share) * done
                                        for wanted, done in zip(WANTED, DONE, strict=True)), 0.06 + 0.1 * share


def line_of(coverage: Coverage) -> str:
    """Return the line of text next to the sphere."""
    if coverage.done:
        return 'all parameters are determined: save the calibration'
    what = coverage.next.text or 'go on'
    return what + ('' if np.isnan(coverage.seconds) or not coverage.seconds else f', about {coverage.seconds:.0f} s left')
