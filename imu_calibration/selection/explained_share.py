"""Which share of what noise leaves unexplained the chosen effects remove, so that none is named beside a cause that nobody asked about."""

from typing import Callable, Sequence

import numpy as np

from imu_calibration.effects.base import SENSORS, Effect
from imu_calibration.selection.evidence import WindowEvidence
from imu_calibration.selection.noise_beside_effects import plausible_processes
from imu_calibration.selection.normal_matrices import scatter_of_each
from imu_calibration.selection.questions import Question
from imu_calibration.selection.search import Search

LEAST_SHARE = 0.7
"""Share of the unexplained that a finding must remove from held-out windows, where a significant rest remains."""
LEAST_SHARE_SMOOTH = 0.9
"""The same for an effect that is smooth in time: any smooth curve resembles any other."""
SHOWS = 0.2
"""An effect shows where it removes at least this share of what it removes elsewhere."""
SIGNIFICANT_REST = 5.0
"""Standard deviations above what noise leaves from which a rest counts as significant."""
ONE_OF_THREE = 6.0 / 5.0
"""So many times that many are asked of one axis alone: there are three, and the fewer there are the more often squares are so large."""


class Explained:
    """
    What noise alone leaves, and what the chosen effects leave, in held-out windows.

    Noise alone has no offsets of windows, and the bias moves as it was found to, as far as biases do. What scatters more within than others
    of its kind has a mean that is less certain: one turn about two fast axes among many slow ones.

    Parameters
    ----------
    evidence : WindowEvidence
    search : Search

    """

    def __init__(self, evidence: WindowEvidence, search: Search):
        self.search, recording = search, evidence.space.recording
        duration = float(np.ptp(recording.time))
        noise = {sensor: own.at_rest_only(*plausible_processes(own, recording.period, sensor=sensor, duration=duration))
                 for sensor, own in evidence.noise.items()}
        every = range(evidence.space.size)
        scatter = scatter_of_each(evidence.space, evidence.noise, evidence.fit(every)[0])
        self.floor = WindowEvidence(evidence.space, noise, evidence.fold, scatter=scatter)
        self.n_means = 3.0 * len(recording.windows)
        self.n_within = 3.0 * (recording.count - 1)[recording.moving].sum()

    def excess(self, chosen: Sequence[Question]) -> dict[str, np.ndarray]:
        """Return sensor -> excess of the means and within windows, of each axis: losses above what noise leaves, held out, shape (2, 3)."""
        losses = self.floor.unpredicted(self.search.used(chosen))
        return {sensor: parts - self._numbers[:, None] / 3.0 for sensor, parts in losses.items()}

    @property
    def _numbers(self):
        return np.array([self.n_means, self.n_within])

    def sigma(self, excess: np.ndarray) -> np.ndarray:
        """
        Return the standard deviations by which the means, and what is within windows, exceed noise, shape (2,).

        Of all axes together or of the one that does so most, which must do so more clearly: the quiet of the others hides what one has.
        """
        together, alone = self._sigmas(excess)
        return np.maximum(together, alone.max(axis=1))

    def _sigmas(self, excess):
        """Return the same of all axes together, shape (2,), and of each alone, shape (2, 3)."""
        sd = np.sqrt(2 * np.maximum(self._numbers, 1.0))
        return excess.sum(axis=1) / sd, excess / (sd / np.sqrt(3.0) * ONE_OF_THREE)[:, None]

    def rest(self, excess: np.ndarray) -> float:
        """Return the part of an excess that noise does not explain: zero where it is not significant."""
        return float(sum(self._rest(excess)))

    def _rest(self, excess):
        """Return the same of the means and within windows, shape (2,)."""
        together, alone = self._sigmas(excess)
        left = np.where(alone > SIGNIFICANT_REST, excess, 0.0).sum(axis=1)
        return np.where(together > SIGNIFICANT_REST, np.maximum(excess.sum(axis=1), left), left)

    def share(self, chosen: Sequence[Question], question: Question) -> float:
        """
        Return the least share of the unexplained that the effect removes, over the sensors in which it shows.

        Of a sensor counts the part in which it shows, the means of windows, what is within them, or both: what nobody explains in the other
        part does not hide it.
        """
        return min((removed / (removed + rest) for removed, rest in self._where_it_shows(chosen, question)), default=0.0)

    def rest_beside(self, chosen: Sequence[Question], question: Question) -> float:
        """Return what the choice leaves that noise does not explain, where the effect shows."""
        return sum(rest for _, rest in self._where_it_shows(chosen, question))

    def _where_it_shows(self, chosen, question):
        """Return (removed by the effect, significant rest beside it) of each sensor in which it shows, of the parts in which it does."""
        with_it, without = self.excess(chosen), self.excess([q for q in chosen if q is not question])
        removed = {s: (without[s] - with_it[s]).sum(axis=1) for s in sensors_of(question.effect)}
        strongest = max(parts.sum() for parts in removed.values())
        # A cause of the table shows in both sensors; where it hardly shows it proves nothing.
        sensors = [s for s, parts in removed.items() if parts.sum() >= SHOWS * strongest > 0]
        shown = {s: removed[s] >= SHOWS * removed[s].max() for s in sensors}
        return [(float(removed[s][shown[s]].sum()), float(self._rest(with_it[s])[shown[s]].sum())) for s in sensors]


def pruned(chosen: Sequence[Question], share: Callable) -> Sequence[Question]:
    """Return the choice without effects that remove too little, weakest first; `share(chosen, question)` says how much each removes."""
    chosen = list(chosen)
    while chosen:
        shares = [share(chosen, question) / needed_share(question) for question in chosen]
        weakest = int(np.argmin(shares))
        if shares[weakest] >= 1.0:
            break
        chosen = chosen[:weakest] + chosen[weakest + 1:]
    return chosen


def needed_share(question: Question) -> float:
    """Return the share of the unexplained that a finding of this effect must remove."""
    return LEAST_SHARE_SMOOTH if question.effect.smooth else LEAST_SHARE


def sensors_of(effect: Effect) -> tuple[str, ...]:
    """Return the sensors that an effect acts on."""
    return (effect.sensor,) if effect.sensor in SENSORS else effect.acts_on
