"""Share of the excess over noise that the chosen effects remove from held-out windows."""

import numpy as np

from imu_calibration.references.turntable.selection.noise_beside_effects import plausible_processes
from imu_calibration.references.turntable.selection.parameter_space import scatter_of_each
from imu_calibration.references.turntable.selection.window_evidence import WindowEvidence
from imu_calibration.selection.explained_share import Explained
from imu_calibration.selection.search import Search


class ExplainedWindows(Explained):
    """
    Excess over noise in the windows of a table, in two parts: means, and samples about them.

    The noise here has no window offsets, and the estimated bias process up to a plausible size. A
    window that scatters more within than its kind has a less certain mean: one turn about two fast
    axes among many slow ones.

    Parameters
    ----------
    evidence : WindowEvidence
    search : Search

    """

    def __init__(self, evidence: WindowEvidence, search: Search):
        recording = evidence.space.recording
        duration = float(np.ptp(recording.time))
        noise = {}
        for sensor, of_sensor in evidence.noise.items():
            processes = plausible_processes(
                of_sensor, recording.period, sensor=sensor, duration=duration
            )
            noise[sensor] = of_sensor.without_misfit(*processes)
        values, _ = evidence.fit(range(evidence.space.size))
        scatter = scatter_of_each(evidence.space, evidence.noise, values)
        self.floor = WindowEvidence(evidence.space, noise, evidence.fold, scatter=scatter)
        """Evidence with this noise."""
        # Numbers of squares of all axes, as in the two parts of `WindowEvidence.unpredicted`.
        n_means = 3.0 * len(recording.windows)
        n_within = 3.0 * (recording.count - 1)[recording.moving].sum()
        numbers = dict.fromkeys(evidence.space.sensors, np.array([n_means, n_within]))
        super().__init__(search, self.floor.unpredicted, numbers)
