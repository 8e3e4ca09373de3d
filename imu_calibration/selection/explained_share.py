"""
Share of the excess over noise that the chosen effects remove.

Prevents findings that stand in for a cause outside the catalogue.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass

import numpy as np

from imu_calibration.selection.questions import Question, without_weakest
from imu_calibration.selection.search import Search

MIN_EXPLAINED_SHARE = 0.7
"""
Share of the excess that a finding must remove from held-out windows, where a significant part
remains.
"""
MIN_SMOOTH_SHARE = 0.9
"""The same for an effect that is smooth in time: any smooth curve resembles any other."""
SHOWS = 0.2
"""
An effect counts in a sensor or part where it removes at least this share of its largest removal.
"""
SIGNIFICANT_REST = 5.0
"""Standard deviations above the expectation from noise from which an excess is significant."""
ONE_OF_THREE = 6.0 / 5.0
"""
Factor on this limit for a single axis: the largest of three is tested, and fewer squares have
heavier tails.
"""


@dataclass(eq=False)
class Explained:
    """Excess over noise on held-out data, and the share of it that effects remove."""

    search: Search
    """The search, with the parameters of its questions."""
    losses: Callable[[Sequence[int]], Mapping[str, np.ndarray]]
    """
    Returns for parameters in use: sensor -> squares on held-out data in units of their noise, shape
    (n_parts, n_axes).
    """
    numbers: Mapping[str, np.ndarray]
    """Sensor -> number of squares of each part, their expectation from noise, shape (n_parts,)."""
    _: KW_ONLY
    least_part: float = SHOWS
    """
    Share of its largest removal with which an effect counts in a part; minus infinity: in all
    parts.
    """

    def excess(self, chosen: Sequence[Question]) -> dict[str, np.ndarray]:
        """
        Return sensor -> held-out loss minus its expectation from noise, of each part and axis.

        Shape (n_parts, n_axes).
        """
        excess = {}
        for sensor, losses in self.losses(self.search.indices(chosen)).items():
            n_axes = losses.shape[1]
            excess[sensor] = losses - self.numbers[sensor][:, None] / n_axes
        return excess

    def sigma(self, sensor: str, excess: np.ndarray) -> np.ndarray:
        """
        Return the excess over noise of each part in standard deviations, shape (n_parts,).

        It is the larger value of all axes together and of the worst axis, with a stricter limit:
        two quiet axes dilute the excess of the third.
        """
        together, alone = self._sigmas(sensor, excess)
        return np.maximum(together, alone.max(axis=1))

    def _sigmas(self, sensor: str, excess: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Return the excess in standard deviations of all axes together, and of each axis.

        Shapes (n_parts,) and (n_parts, n_axes). A sum of n squares of unit noise has the variance
        2 n; the limit of a single axis is stricter by `ONE_OF_THREE`.
        """
        sd = np.sqrt(2 * np.maximum(self.numbers[sensor], 1.0))
        sd_of_axis = sd / np.sqrt(excess.shape[1]) * ONE_OF_THREE
        return excess.sum(axis=1) / sd, excess / sd_of_axis[:, None]

    def remaining_excess(self, chosen: Sequence[Question]) -> float:
        """Return the sum of the excess over the sensors, parts and axes where it is significant."""
        total = 0.0
        for sensor, excess in self.excess(chosen).items():
            total += self._significant_excess(sensor, excess).sum()
        return float(total)

    def _significant_excess(self, sensor: str, excess: np.ndarray) -> np.ndarray:
        """
        Return the significant excess of one sensor in each part, shape (n_parts,).

        It is that of the significant axes, or of all axes if they are significant together and sum
        to more.
        """
        together, alone = self._sigmas(sensor, excess)
        of_significant_axes = np.where(alone > SIGNIFICANT_REST, excess, 0.0).sum(axis=1)
        of_all_axes = np.maximum(excess.sum(axis=1), of_significant_axes)
        return np.where(together > SIGNIFICANT_REST, of_all_axes, of_significant_axes)

    def share(self, chosen: Sequence[Question], question: Question) -> float:
        """
        Return the least ``removed / (removed + remaining)`` of the sensors in which an effect acts.

        Removed is the fall of the excess over noise by the effect in the choice, remaining the
        excess with it. In each sensor only the parts with the effect count (means of windows,
        within windows, or both): an unexplained excess in the other part does not hide it.
        """
        shows = self._where_it_shows(chosen, question)
        return min((removed / (removed + remaining) for removed, remaining in shows), default=0.0)

    def remaining_beside(self, chosen: Sequence[Question], question: Question) -> float:
        """Return the significant excess of the choice in the parts on which the effect acts."""
        return sum(remaining for _, remaining in self._where_it_shows(chosen, question))

    def _where_it_shows(
        self, chosen: Sequence[Question], question: Question
    ) -> list[tuple[float, float]]:
        """
        Return (excess that the effect removes, remaining significant excess) of each sensor.

        Both are sums over the parts in which the removal is at least `least_part` of the largest.
        Sensors of which little is removed are omitted.
        """
        excess_with = self.excess(chosen)
        excess_without = self.excess([q for q in chosen if q is not question])
        removed_of = {}  # sensor -> of each part
        for sensor in question.effect.sensors:
            removed_of[sensor] = (excess_without[sensor] - excess_with[sensor]).sum(axis=1)

        # A cause in the table acts on both sensors; a sensor with a weak signal is no evidence.
        strongest = max(removed.sum() for removed in removed_of.values())
        shows = []
        for sensor, removed in removed_of.items():
            if not removed.sum() >= SHOWS * strongest > 0:
                continue
            in_part = removed >= self.least_part * removed.max()
            remaining = self._significant_excess(sensor, excess_with[sensor])
            shows.append((float(removed[in_part].sum()), float(remaining[in_part].sum())))
        return shows


def pruned(
    chosen: Sequence[Question], share: Callable[[Sequence[Question], Question], float]
) -> Sequence[Question]:
    """
    Return the choice without effects that remove too little, weakest first.

    `share(chosen, question)` is the share of the excess that an effect of a choice removes.
    """

    def weakest(kept: list[Question]) -> int | None:
        """Return the place of the effect with the least share over the needed one, if below it."""
        ratios = [share(kept, question) / needed_share(question) for question in kept]
        place = int(np.argmin(ratios))
        return place if ratios[place] < 1.0 else None

    return without_weakest(chosen, weakest)


def needed_share(question: Question) -> float:
    """Return the share of the unexplained that a finding of this effect must remove."""
    return MIN_SMOOTH_SHARE if question.effect.smooth else MIN_EXPLAINED_SHARE
