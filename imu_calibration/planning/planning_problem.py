"""
The inputs of a plan.

The chain, the model in tolerances, the noise, and the information of every motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from itertools import product
from typing import NamedTuple

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
"""Lengths of session that are tried for each share."""


class TimedWindows(NamedTuple):
    """The windows of consecutive motions."""

    windows: list[PlannedWindow]
    middles: np.ndarray
    """Their middles since the beginning, s, shape (k,)."""
    seconds: float
    """Total time of the motions, s."""


class PlanningProblem:
    """
    Candidates and criteria of a planner.

    Parameters
    ----------
    library : MotionLibrary
        Motions to choose from, each from rest to rest at one of its places.
    coordinates : Coordinates
        The parameters as ``values = point + units * (basis @ z)``.
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
        self.known_information: np.ndarray | None = None
        """Information about z of an earlier calibration, in addition to the prior."""
        self.goal: Goal = WithinTolerances(coordinates)
        self._information_of_moves: dict[int, np.ndarray] = {}
        """Place -> information in the move to each place, shape (n_places, m, m)."""
        self.predictor = WindowPredictor(library.table, coordinates, noise, rate=rate)

    @property
    def motions(self) -> list[PlannedMotion]:
        """Motions to choose from."""
        return self.library.motions

    @cached_property
    def seconds(self) -> np.ndarray:
        """Length of each motion without the move to its place, s, shape (k,)."""
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
    def moves(self) -> dict[tuple[int, int], tuple[Segment, ...]]:
        """(place, other place) -> segments of the move from one to the other."""
        places = self.library.places
        moves = {}
        for a, b in product(range(len(places)), repeat=2):
            builder = MotionBuilder(len(places[a]), limits=self.library.limits, start=places[a])
            moves[a, b] = builder.move_to(places[b]).segments
        return moves

    @cached_property
    def move_windows(self) -> dict[tuple[int, int], list[PlannedWindow]]:
        """(place, other place) -> the windows of the move from one to the other."""
        return dict(zip(self.moves, self.predictor.predict(list(self.moves.values())), strict=True))

    @cached_property
    def move_seconds(self) -> np.ndarray:
        """Duration of the move from place i to place j, s, shape (n_places, n_places)."""
        n_places = len(self.library.places)
        seconds = np.zeros((n_places, n_places))
        for (start, end), segments in self.moves.items():
            seconds[start, end] = sum(segment.duration for segment in segments)
        return seconds

    @cached_property
    def visits(self) -> list[tuple[list[PlannedWindow], float]]:
        """(windows, length in s) of each motion without its move, and of each move with windows."""
        motions = zip(self.windows, self.seconds.tolist(), strict=True)
        visits = [(windows, length) for windows, length in motions if length > 0]
        for key, windows in self.move_windows.items():
            if windows:
                visits.append((windows, float(self.move_seconds[key])))
        return visits

    def move_information(self, place: int) -> np.ndarray:
        """
        Return the information about z and the biases in the move from a place to each motion.

        Shape (k, m, m).
        """
        if place not in self._information_of_moves:
            posterior = self.posterior()
            information = []
            for target in range(len(self.library.places)):
                information.append(posterior.information_of(self.move_windows[place, target]))
            self._information_of_moves[place] = np.array(information)
        return self._information_of_moves[place][self.library.place_of]

    @property
    def prior(self) -> np.ndarray:
        """Information about z before any motion, shape (n, n)."""
        if self.known_information is None:
            return self.coordinates.prior_information
        return self.coordinates.prior_information + self.known_information

    def posterior(self) -> Posterior:
        """Return the posterior before any motion."""
        return Posterior(self.prior, self.noise)

    def place_near(self, position: np.ndarray) -> int:
        """
        Return the number of the place nearest to a position, without whole turns of endless joints.
        """
        offset = self.library.places - position
        turns = np.where(self.library.limits.endless, np.round(offset / (2 * np.pi)), 0.0)
        return int(np.argmin(np.abs(offset - 2 * np.pi * turns).sum(axis=1)))

    def first_rests(self, place: int) -> list[int]:
        """
        Return the numbers of the motions at rest with which a session from a place begins.

        They are in widely different attitudes; the next place is always the nearest one, and the
        first rest is longer. A chain with fewer attitudes than rests visits them again.
        """
        # Place -> its motions at rest. The library has the places with the largest differences in
        # attitude first.
        rests_at: dict[int, list[int]] = {}
        for number, motion in enumerate(self.motions):
            if motion.kind is MotionKind.POSE:
                rests_at.setdefault(int(self.library.place_of[number]), []).append(number)
        unvisited = list(rests_at)[:LEAST_RESTS]
        chosen: list[int] = []
        visited: list[int] = []
        here = place
        while len(chosen) < LEAST_RESTS and (unvisited or len(visited) > 1):
            if not unvisited:  # again, in the order of the first visits
                unvisited = [visit for visit in dict.fromkeys(visited) if visit != here]
            here = min(unvisited, key=lambda target: self.move_seconds[here, target])
            unvisited.remove(here)
            visited.append(here)
            rests = rests_at[here]
            if not chosen:
                rests = [number for number in rests if self.seconds[number] >= FIRST_REST]
            chosen.append(min(rests, key=self.seconds.__getitem__))
        return chosen

    def variance_factor(self, windows: Sequence[PlannedWindow]) -> float:
        """
        Return a factor that (estimated / true noise variance) exceeds on none of six axes.

        That holds with the probability P = PROBABILITY. The variance is estimated from the windows
        at rest, with BATCH_DOF degrees of freedom each::

            factor = chi2_isf((1 - P) / 6, nu) / nu
            nu     = BATCH_DOF * n_rests,  n_rests = (sum samples)^2 / sum samples^2

        After an earlier calibration the noise was estimated from LEAST_RESTS more rests. Goals of
        separation contain a probability already: 1.
        """
        if not isinstance(self.goal, WithinTolerances):
            return 1.0
        samples = np.array([window.samples for window in windows if window.kind == 'static'])
        # Number of rests of equal length with the same variance of the estimate.
        n_rests = samples.sum() ** 2 / (samples**2).sum() if len(samples) else 1.0
        if self.known_information is not None:
            n_rests += LEAST_RESTS
        return float(chi2_isf((1 - PROBABILITY) / 6, BATCH_DOF * n_rests) / (BATCH_DOF * n_rests))

    def least_session(self) -> float:
        """Return the least time of the first rests of a session and the moves between them, s."""
        rests = self.first_rests(0)
        if len(rests) <= 1:
            return 0.0
        to_other_places = self.move_seconds[~np.eye(len(self.move_seconds), dtype=bool)]
        shortest_move = to_other_places.min(initial=np.inf)
        return float(self.seconds[rests].sum() + (len(rests) - 1) * shortest_move)

    def lower_bound(self, *, factor: float = 1.0, relaxed: Relaxation | None = None) -> float:
        """
        Return a time below which no plan of these motions meets the tolerances, s.

        The plans are made of these motions and the moves between their places. NaN where a
        tolerance is out of reach.

        After an earlier calibration it is the time of the relaxed plan. Otherwise it is the largest
        of this time, the time that the biases need by themselves, that of the first rests, and
        bounds with a share of the bias wander that is common to a session of at most T: such a
        share limits the biases for any amount of data. With value(T) of the relaxation for
        sessions of T, every plan needs at least ``min(T, value(T))``; a few T are tried.

        Parameters
        ----------
        factor : float
            On the variance of the noise within windows.
        relaxed : Relaxation, optional
            The relaxation for this factor, where it is available already.

        """
        bound = (relaxed or self.relaxation(factor=factor)).seconds
        if self.known_information is not None or not np.isfinite(bound):
            return bound
        bias_seconds = self._bias_seconds(factor)
        if not np.isfinite(bias_seconds):
            return float('nan')
        # The common share matters only where the biases determine the time.
        shares = COMMON_SHARES if bias_seconds > 0.3 * bound else ()
        for share in shares:
            session = max(bound, bias_seconds)
            for _ in range(ROUNDS_OF_LENGTH):
                value = self.relaxation(share=share, session=session, factor=factor).seconds
                bound = max(bound, min(session, value))
                # The best session has value(T) = T: the next one is the geometric mean of both, at
                # most three times longer.
                if value < 1.05 * session:
                    break
                session = float(np.sqrt(session * min(value, 9.0 * session)))
        return max(bound, bias_seconds, self.least_session())

    def _bias_seconds(self, factor: float) -> float:
        """
        Return the least time of continuous observation from which each bias meets its tolerance, s.

        It is infinite if one bias never does. `factor`: on the variance of the noise within
        windows.
        """
        coordinates = self.coordinates
        lengths = np.geomspace(0.01, MAX_REACHABLE_SECONDS, 2000)
        seconds = 0.0
        for sensor in SENSORS:
            biases = coordinates.model.part(sensor, Role.OFFSET)
            for axis, parameter in enumerate(range(biases.start, biases.stop)):
                # Largest variance of the observations: 1 / tolerated = 1 / prior + 1 / largest.
                prior = coordinates.prior_sd[parameter] ** 2
                tolerated = coordinates.tolerances[parameter] ** 2
                largest = 1.0 / (1.0 / tolerated - 1.0 / prior) if tolerated < prior else np.inf
                white = factor * self.noise[sensor].low_variance[axis] / self.rate
                suffices = least_bias_variance(self.noise[sensor], white, lengths) <= largest
                if not suffices.any():
                    return np.inf
                # The bound is the last length of the grid that is too short.
                last_too_short = max(int(np.argmax(suffices)) - 1, 0)
                seconds = max(seconds, float(lengths[last_too_short]))
        return seconds

    def relaxation(
        self, *, share: float = 0.0, session: float = 0.0, factor: float = 1.0
    ) -> Relaxation:
        """
        Return the relaxed plan: fractional visits of motions and moves, with additive information.

        `share` of the biases' covariance is common to a session of at most `session` s; `factor`:
        on the variance of the noise within windows.
        """
        # Upper bound of the information of each visit.
        information = np.zeros((len(self.visits), *self.coordinates.prior_information.shape))
        for number, (windows, _) in enumerate(self.visits):
            for window in windows:
                information[number] += additive_bound(
                    window, self.noise, share=1.0 - share, factor=factor
                )
        seconds = np.array([length for _, length in self.visits])
        prior = self.prior
        rows = self.coordinates.requested_rows
        if share:
            prior, rows = self._with_common_offset(prior, rows, share, session)
        return relax(information, seconds, prior, rows=rows)

    def _with_common_offset(
        self, prior: np.ndarray, rows: np.ndarray, share: float, session: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """
        Return (prior information, requested rows) for biases with an offset common to a session.

        Windows observe only the sum b of a bias and the offset, which takes the place of the bias
        among the coordinates z. With the prior variances P of the bias and P' = P + Q of b::

            var(bias) = P Q / P' + (P / P')^2 var(b),   Q = share * common_variance

        The tolerance 1 of the bias is thus a tolerance ``(1 - P Q / P') (P' / P)^2`` on var(b), by
        whose root its row is divided.
        """
        prior = prior.copy()
        rows = rows.copy()
        coordinates = self.coordinates
        n_params = len(coordinates.model.param_names)
        for sensor in SENSORS:
            biases = coordinates.model.part(sensor, Role.OFFSET)
            for parameter in range(*biases.indices(n_params)):
                place = int(np.argmax(np.abs(coordinates.basis[parameter])))
                bias_variance = 1.0 / prior[place, place]
                offset_variance = (
                    share
                    * common_variance(self.noise[sensor], session)
                    / coordinates.units[parameter] ** 2
                )
                total = bias_variance + offset_variance
                tolerated = (1.0 - bias_variance * offset_variance / total) * (
                    total / bias_variance
                ) ** 2
                prior[place, place] = 1.0 / total
                # Only the row of this bias has an element at its place, 1. Without any margin a
                # small number is used: the value of the relaxation then exceeds any session of
                # interest.
                rows[np.abs(rows[:, place]) > 0.5] /= np.sqrt(max(tolerated, 1e-4))
        return prior, rows

    def timed(self, sequence: Sequence[int], start: int) -> TimedWindows:
        """
        Return the windows of consecutive motions from the place `start`, with the moves between.
        """
        windows = []
        middles = []
        now = 0.0
        place = start
        for number in sequence:
            target = int(self.library.place_of[number])
            move = (self.move_windows[place, target], self.move_seconds[place, target])
            motion = (self.windows[number], self.seconds[number])
            for new_windows, seconds in (move, motion):
                windows += new_windows
                middles += [now + window.middle for window in new_windows]
                now += seconds
            place = target
        return TimedWindows(windows, np.array(middles), float(now))

    def covariance_after(
        self, sequence: Sequence[int], start: int, *, cautious: bool = False
    ) -> tuple[np.ndarray, float]:
        """
        Return (covariance of z, total time) after consecutive motions from a place.

        `cautious`: with `variance_factor`.
        """
        windows, middles, seconds = self.timed(sequence, start)
        information = self.prior
        if windows:
            factor = self.variance_factor(windows) if cautious else 1.0
            information = information + exact_information(
                windows, middles, self.noise, factor=factor
            )
        return np.linalg.inv(information), seconds

    def best_covariance(self, seconds: float) -> np.ndarray:
        """
        Return a lower bound of the covariance of z after any plan of these motions in a time, s.

        For the bound every motion fills the whole time, all at once, and the biases are independent
        between windows.
        """
        information = self.prior
        for windows, length in self.visits:
            if windows:
                per_visit = sum(additive_bound(window, self.noise) for window in windows)
                n_visits = max(seconds / length, 1.0)
                information = information + per_visit * n_visits
        return np.linalg.inv(information)


def noise_of_grade(noise: SimulatedNoise, rate: float) -> dict[str, NoiseModel]:
    """
    Return sensor -> NoiseModel of the samples of a simulated IMU.

    A model has white noise, and a bias that wanders by the instability of the sensor.

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
    noise_of = {}
    for sensor, (density, instability, resolution) in figures.items():
        processes = ()
        if instability > 0:
            processes = (BiasProcess(instability, noise.correlation_time),)
        # White noise of a sample, and the variance of rounding to the resolution.
        variance = np.full(3, density**2 * rate + resolution**2 / 12)
        noise_of[sensor] = NoiseModel(variance, np.ones(3), bias_processes=processes)
    return noise_of


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
