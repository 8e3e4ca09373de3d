"""
The inputs of a plan.

The chain, the model in tolerances, the noise, and the information of every motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from itertools import product

import numpy as np

from imu_calibration.allan.figures import NoiseFigures, bias_processes
from imu_calibration.core.distributions import chi2_isf
from imu_calibration.core.errors import InputError
from imu_calibration.effects.base import SENSORS, Role
from imu_calibration.estimation.sensor_noise import BiasProcess
from imu_calibration.planning.coordinates import Coordinates, Goal, WithinTolerances
from imu_calibration.planning.motion_library import MotionKind, MotionLibrary, PlannedMotion
from imu_calibration.planning.posterior import (
    MAX_REACHABLE_SECONDS,
    PlannedWindow,
    Posterior,
    Relaxation,
    WindowPredictor,
    additive_bound,
    common_variance,
    exact_information,
    least_bias_variance,
    relax,
)
from imu_calibration.references.turntable.noise_model import NoiseModel
from imu_calibration.references.turntable.window_statistics import BATCH_DOF
from imu_calibration.simulation.motion_builder import MotionBuilder, Segment
from imu_calibration.simulation.sensor_noise import GRADES, SimulatedNoise

FIRST_REST = 4.0
"""Seconds of the first rest at least, from which the noise of the IMU is estimated."""
LEAST_RESTS = 6
"""
Rests with which a session begins: with the motions between them, 11 windows for the proof and for a
diagnosis, which hold out some.
"""
PROBABILITY = 0.95
"""Probability that a calibration of the plan reports every parameter within its tolerance."""
COMMON_SHARES = (0.5, 0.9)
"""Shares of the biases' covariance that are tried as common to a session in the lower bound."""
ROUNDS_OF_LENGTH = 3
"""Lengths of session that are tried for each of them."""


class PlanningProblem:
    """
    Candidates and criteria of a planner.

    Parameters
    ----------
    library : MotionLibrary
    coordinates : Coordinates
    noise : dict
        Sensor -> NoiseModel of single samples.
    rate : float
        Samples per second.

    """

    def __init__(
        self,
        library: MotionLibrary,
        coordinates: Coordinates,
        noise: dict[str, NoiseModel],
        *,
        rate: float = 100.0,
    ):
        self.library = library
        self.coordinates = coordinates
        self.noise = noise
        self.rate = rate
        self.known: np.ndarray | None = None
        """Information about z of an earlier calibration, in addition to the prior."""
        self.goal: Goal = WithinTolerances(coordinates)
        self._of_moves: dict[int, np.ndarray] = {}
        """Place -> information in the moves to all places."""
        self.predictor = WindowPredictor(library.table, coordinates, noise, rate=rate)

    @property
    def motions(self) -> list[PlannedMotion]:
        """Motions to choose from."""
        return self.library.motions

    @cached_property
    def seconds(self) -> np.ndarray:
        """Length of each motion without the way to it, s, shape (k,)."""
        return np.array([motion.seconds for motion in self.motions])

    @cached_property
    def windows(self) -> list[list[PlannedWindow]]:
        """Windows of each motion."""
        return self.predictor.predict([motion.segments for motion in self.motions])

    @cached_property
    def information(self) -> np.ndarray:
        """Information of each motion about z and the biases at its time, shape (k, m, m)."""
        posterior = self.posterior()
        return np.array([posterior.information_of(windows) for windows in self.windows])

    @cached_property
    def ways(self) -> dict[tuple[int, int], tuple[Segment, ...]]:
        """(place, place) -> the move from one to the other."""
        places = self.library.places
        ways = {}
        for a, b in product(range(len(places)), repeat=2):
            builder = MotionBuilder(len(places[a]), limits=self.library.limits, start=places[a])
            ways[a, b] = builder.move_to(places[b]).segments
        return ways

    @cached_property
    def way_windows(self) -> dict[tuple[int, int], list[PlannedWindow]]:
        """(place, place) -> the windows of that move."""
        return dict(zip(self.ways, self.predictor.predict(list(self.ways.values())), strict=True))

    @cached_property
    def way_seconds(self) -> np.ndarray:
        """Length of each move, s, shape (n_places, n_places)."""
        seconds = np.zeros((len(self.library.places),) * 2)
        for places, way in self.ways.items():
            seconds[places] = sum(segment.duration for segment in way)
        return seconds

    def way_information(self, place: int) -> np.ndarray:
        """
        Return the information about z and the biases in the move from a place to each motion.

        Shape (k, m, m).
        """
        if place not in self._of_moves:
            posterior = self.posterior()
            of_moves = []
            for target in range(len(self.library.places)):
                of_moves.append(posterior.information_of(self.way_windows[place, target]))
            self._of_moves[place] = np.array(of_moves)
        return self._of_moves[place][self.library.place_of]

    @property
    def prior(self) -> np.ndarray:
        """Information about z before any motion, shape (n, n)."""
        return self.coordinates.prior_information + (0.0 if self.known is None else self.known)

    def posterior(self) -> Posterior:
        """Return the posterior before any motion."""
        return Posterior(self.prior, self.noise)

    def place_near(self, position: np.ndarray) -> int:
        """
        Return the number of the place nearest to a position, without whole turns of endless joints.
        """
        away = self.library.places - position
        turns = np.where(self.library.limits.endless, np.round(away / (2 * np.pi)), 0.0)
        return int(np.argmin(np.abs(away - 2 * np.pi * turns).sum(axis=1)))

    def first_rests(self, place: int) -> list[int]:
        """
        Return the first rests of a session, in widely different attitudes.

        Each place is the nearest one, and the first rest is longer.
        """
        # Motions at rest of each place; places are in the order of their distance in attitude.
        rests_at: dict[int, list[int]] = {}
        for number, motion in enumerate(self.motions):
            if motion.kind is MotionKind.POSE:
                rests_at.setdefault(int(self.library.place_of[number]), []).append(number)
        unvisited = list(rests_at)[:LEAST_RESTS]
        chosen: list[int] = []
        visited: list[int] = []
        while len(chosen) < LEAST_RESTS and (unvisited or len(chosen) > 1):
            if not unvisited:  # a chain with few attitudes returns to them
                unvisited = [at for at in dict.fromkeys(visited) if at != place]
            place = min(unvisited, key=lambda at: self.way_seconds[place, at])
            unvisited.remove(place)
            visited.append(place)
            rests = rests_at[place]
            if not chosen:
                rests = [number for number in rests if self.seconds[number] >= FIRST_REST]
            chosen.append(min(rests, key=self.seconds.__getitem__))
        return chosen

    def variance_factor(self, windows: Sequence[PlannedWindow]) -> float:
        """
        Return the factor on the noise variance that its estimate exceeds on none of six axes.

        With probability PROBABILITY.

        ``chi2_isf((1 - P) / 6, nu) / nu`` with nu degrees of freedom for each window at rest,
        weighted by its samples. Where something is known, the noise was estimated from the rests of
        a whole session already. Goals of separation contain a probability.
        """
        if not isinstance(self.goal, WithinTolerances):
            return 1.0
        counts = np.array([window.samples for window in windows if window.kind == 'static'])
        # Rests of equal length with the same variance of the estimate.
        rests = counts.sum() ** 2 / (counts**2).sum() if len(counts) else 1.0
        if self.known is not None:
            rests += LEAST_RESTS
        return float(chi2_isf((1 - PROBABILITY) / 6, BATCH_DOF * rests) / (BATCH_DOF * rests))

    def least_session(self) -> float:
        """
        Return the least time of the first rests and of the ways between them, s.

        These are the rests with which a session begins.
        """
        rests = self.first_rests(0)
        if len(rests) <= 1:
            return 0.0
        away = self.way_seconds[~np.eye(len(self.way_seconds), dtype=bool)]
        return float(self.seconds[rests].sum() + (len(rests) - 1) * away.min(initial=np.inf))

    def lower_bound(self, *, factor: float = 1.0, relaxed: Relaxation | None = None) -> float:
        """
        Return a time below which no plan of these motions meets the tolerances, s.

        The plans are made of these motions and the moves between their places.

        With the variance of the noise within windows larger by `factor`. NaN where a tolerance is
        out of reach. `relaxed` is the relaxation for the same arguments where it is available
        already.

        Without prior information on the biases, a share of their wander is common to a session of
        at most T, which limits their parameters for any amount of data: every plan needs at least
        ``min(T, value(T))``, the value that of the relaxation for sessions of T. The largest bound
        over T is used; without any T the share is zero.
        """
        best = (relaxed or self.relaxation(factor=factor)).seconds
        if self.known is not None or not np.isfinite(best):
            return best
        floor = self._bias_floor(factor)
        if not np.isfinite(floor):
            return float('nan')
        for share in COMMON_SHARES if floor > 0.3 * best else ():
            seconds = max(best, floor)
            for _ in range(ROUNDS_OF_LENGTH):
                value = self.relaxation(common=(share, seconds), factor=factor).seconds
                best = max(best, min(seconds, value))
                if value < 1.05 * seconds:
                    break
                seconds = float(np.sqrt(seconds * min(value, 9.0 * seconds)))
        return max(best, floor, self.least_session())

    def _bias_floor(self, factor: float) -> float:
        """
        Return the observation time that the biases alone need, s.

        Infinite if they are out of reach.
        """
        coordinates = self.coordinates
        lengths = np.geomspace(0.01, MAX_REACHABLE_SECONDS, 2000)
        floor = 0.0
        for sensor in SENSORS:
            biases = coordinates.model.part(sensor, Role.OFFSET)
            for k, parameter in enumerate(range(biases.start, biases.stop)):
                # The observations must have at most this variance: 1/wanted = 1/prior + 1/room.
                prior = coordinates.prior_sd[parameter] ** 2
                wanted = coordinates.tolerances[parameter] ** 2
                room = 1.0 / (1.0 / wanted - 1.0 / prior) if wanted < prior else np.inf
                white = factor * self.noise[sensor].low_variance[k % 3] / self.rate
                enough = least_bias_variance(self.noise[sensor], white, lengths) <= room
                if not enough.any():
                    return np.inf
                # The last length that is too short.
                floor = max(floor, float(lengths[max(int(np.argmax(enough)) - 1, 0)]))
        return floor

    def relaxation(
        self, *, common: tuple[float, float] = (0.0, 0.0), factor: float = 1.0
    ) -> Relaxation:
        """
        Return the relaxed plan.

        `common`: (share of the biases' covariance, seconds of the longest session that counts).
        """
        share, seconds = common
        edges = [key for key, windows in self.way_windows.items() if windows]
        own = np.flatnonzero(self.seconds > 0)
        visits = [self.windows[number] for number in own]
        visits += [self.way_windows[key] for key in edges]
        most = np.zeros((len(visits), *self.coordinates.prior_information.shape))
        for number, windows in enumerate(visits):
            for window in windows:
                most[number] += additive_bound(window, self.noise, share=1.0 - share, factor=factor)
        cost = np.concatenate([self.seconds[own], [self.way_seconds[key] for key in edges]])
        prior, asked = self.prior, self.coordinates.asked
        if share:
            prior, asked = self._with_common(prior, asked, share, seconds)
        return relax(most, cost, prior, asked=asked)

    def _with_common(self, prior, asked, share, seconds):
        """
        Return (prior information, requested rows) with one coordinate b for two offsets.

        A bias and the offset common to the session are this one coordinate b.

        With P and P' the prior variances of the bias and of b, ``var(bias) = (1 / P + 1 / (P' -
        P))^-1 + (P / P')^2 var(b)``.
        """
        prior = prior.copy()
        asked = asked.copy()
        model = self.coordinates.model
        for sensor in SENSORS:
            for parameter in range(
                *model.part(sensor, Role.OFFSET).indices(len(model.param_names))
            ):
                place = int(np.argmax(np.abs(self.coordinates.basis[parameter])))
                before = 1.0 / prior[place, place]
                offset = (
                    share
                    * common_variance(self.noise[sensor], seconds)
                    / self.coordinates.units[parameter] ** 2
                )
                after = before + offset
                room = (1.0 - before * offset / after) * (after / before) ** 2
                prior[place, place] = 1.0 / after
                # Without any margin a small number is used: the value then exceeds any session of
                # interest.
                asked[np.abs(asked[:, place]) > 0.5] /= np.sqrt(max(room, 1e-4))
        return prior, asked

    def timed(
        self, sequence: Sequence[int], start: int
    ) -> tuple[list[PlannedWindow], np.ndarray, float]:
        """
        Return (windows, their middles, total time) of motions one after the other from a place.

        With the ways between them.
        """
        windows = []
        times = []
        now = 0.0
        place = start
        for number in sequence:
            target = int(self.library.place_of[number])
            way = (self.way_windows[place, target], self.way_seconds[place, target])
            for part, seconds in (way, (self.windows[number], self.seconds[number])):
                windows += part
                times += [now + window.middle for window in part]
                now += seconds
            place = target
        return windows, np.array(times), float(now)

    def covariance_after(
        self, sequence: Sequence[int], start: int, *, cautious: bool = False
    ) -> tuple[np.ndarray, float]:
        """
        Return (covariance of z, total time) after motions one after the other from a place.

        `cautious`: with `variance_factor`.
        """
        windows, times, seconds = self.timed(sequence, start)
        total = self.prior
        if windows:
            total = total + exact_information(
                windows,
                times,
                self.noise,
                factor=self.variance_factor(windows) if cautious else 1.0,
            )
        return np.linalg.inv(total), seconds

    def best_covariance(self, seconds: float) -> np.ndarray:
        """
        Return a lower bound of the covariance of z of all plans in this time.

        The plans consist of these motions and their moves.

        Every motion fills the whole time at once, and the biases are independent between windows.
        """
        moves = [
            (windows, float(self.way_seconds[key]))
            for key, windows in self.way_windows.items()
            if windows
        ]
        everything = [*zip(self.windows, self.seconds.tolist(), strict=True), *moves]
        total = self.prior
        for windows, length in everything:
            if windows:
                total = total + sum(additive_bound(window, self.noise) for window in windows) * max(
                    seconds / length, 1.0
                )
        return np.linalg.inv(total)


def noise_of_grade(noise: SimulatedNoise, rate: float) -> dict[str, NoiseModel]:
    """
    Return sensor -> NoiseModel of the samples of a simulated IMU.

    White noise, and a bias that wanders by its instability.

    Parameters
    ----------
    noise : SimulatedNoise
    rate : float
        Samples per second.

    """
    figures = {
        'accelerometer': (noise.accel_density, noise.accel_instability, noise.accel_resolution),
        'gyroscope': (noise.gyro_density, noise.gyro_instability, noise.gyro_resolution),
    }
    found = {}
    for sensor, (density, instability, resolution) in figures.items():
        found[sensor] = NoiseModel(
            np.full(3, density**2 * rate + resolution**2 / 12),
            np.ones(3),
            bias_processes=(
                (BiasProcess(instability, noise.correlation_time),) if instability > 0 else ()
            ),
        )
    return found


def expected_noise(figures: NoiseFigures | None, grade: str, rate: float) -> dict[str, NoiseModel]:
    """
    Return sensor -> NoiseModel of samples at `rate` (Hz): the identified model, or that of a grade.
    """
    if grade not in GRADES:
        raise InputError(
            f"the grade must be one of {', '.join(sorted(GRADES))}, got '{grade}'; choose one, or"
            ' give the noise'
        )
    if figures is None:
        return noise_of_grade(GRADES[grade].noise, rate)
    figures.require_both_sensors('record both sensors')
    slow = bias_processes(figures)  # the slow part as Gauss-Markov processes
    noise = {}
    for sensor in SENSORS:
        variance = np.array([axis.white**2 * rate for axis in figures.sensor(sensor)])
        noise[sensor] = NoiseModel(variance, np.ones(3), bias_processes=slow[sensor])
    return noise
