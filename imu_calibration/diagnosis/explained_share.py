"""Whether the chosen effects explain, window by window, or only tell a story beside a cause that nobody asked about."""

from dataclasses import replace

import numpy as np

from imu_calibration.diagnosis.evidence import Evidence
from imu_calibration.diagnosis.noise import natural_wander
from imu_calibration.diagnosis.wander_search import TIMES
from imu_calibration.effects.base import SENSORS

LEAST_SHARE = 0.7
"""Share of the unexplained that a finding must remove from held-out windows, where a significant rest remains."""
LEAST_SHARE_SMOOTH = 0.9
"""The same for an effect that is smooth in time: any smooth curve resembles any other."""
SIGNIFICANT_REST = 5.0
"""Standard deviations above what noise leaves from which a rest counts as significant."""


def floor_noise(noise, lifted):
    """Return the noise without offsets of windows and without more wander than every bias has."""
    floor = {}
    for sensor in SENSORS:
        own = noise[sensor]
        within = {kind: factor / own.bend[kind] for kind, factor in own.within.items()}
        floor[sensor] = replace(own, within=within, offset_sd=0.0, wander_sd=natural_wander(own, lifted), wander_time=TIMES[0])
    return floor


class Explained:
    """What noise alone leaves, and what the chosen effects leave, in held-out windows."""

    def __init__(self, evidence, search):
        self.search, lifted = search, evidence.space.lifted
        self.floor = Evidence(evidence.space, floor_noise(evidence.noise, lifted), evidence.fold)
        self.chosen = evidence.fold >= 0
        self.n_means = 3.0 * self.chosen.sum()
        self.n_within = 3.0 * (lifted.count - 1)[self.chosen & (lifted.kind != 'static')].sum()

    def excess(self, chosen):
        """Return sensor -> (excess of the means, excess within windows): losses above what noise leaves, on held-out windows."""
        means, within = self.floor.window_losses(self.search.used(chosen))
        return {s: (float(np.nansum(means[s]) - self.n_means), float(np.nansum(within[s]) - self.n_within)) for s in SENSORS}

    def rest(self, excess):
        """Return the part of an excess that noise does not explain: zero where it is not significant."""
        limits = (SIGNIFICANT_REST * np.sqrt(2 * self.n_means), SIGNIFICANT_REST * np.sqrt(2 * self.n_within))
        return sum(value for value, limit in zip(excess, limits) if value > limit)

    def share(self, chosen, question):
        """Return the least share of the unexplained that the effect removes, over the sensors in which it shows."""
        with_it, without = self.excess(chosen), self.excess([q for q in chosen if q is not question])
        removed = {s: sum(without[s]) - sum(with_it[s]) for s in sensors_of(question.effect)}
        strongest = max(removed.values())
        if strongest <= 0:
            return 0.0
        # A cause of the table shows in both sensors; where it hardly shows it proves nothing.
        return min(value / (value + self.rest(with_it[s])) for s, value in removed.items() if value >= 0.2 * strongest)


def pruned(chosen, share):
    """Return the choice without effects that remove too little, weakest first; `share(chosen, question)` says how much each removes."""
    chosen = list(chosen)
    while chosen:
        shares = [share(chosen, question) / needed_share(question) for question in chosen]
        weakest = int(np.argmin(shares))
        if shares[weakest] >= 1.0:
            break
        chosen = chosen[:weakest] + chosen[weakest + 1:]
    return chosen


def needed_share(question):
    """Return the share of the unexplained that a finding of this effect must remove."""
    return LEAST_SHARE_SMOOTH if question.name.endswith(('_thermal_bias', '_bias_drift')) else LEAST_SHARE


def sensors_of(effect):
    """Return the sensors that an effect acts on."""
    return (effect.sensor,) if effect.sensor in SENSORS else effect.acts_on
