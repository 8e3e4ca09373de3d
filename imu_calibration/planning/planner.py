"""Planner: greedy search of motions by gain per second, with exchange."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from typing import Any

import numpy as np

from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.core.progress import report
from imu_calibration.document.calibration import Calibration
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.solution import tolerances_of
from imu_calibration.kinematics.motion_limits import MotionLimits, TrajectoryPoints, limits_of
from imu_calibration.kinematics.table import Table
from imu_calibration.planning.coordinates import Coordinates, ToldApart, WithinTolerances
from imu_calibration.planning.motion_library import (
    MotionKind,
    MotionLibrary,
    PlannedMotion,
    trajectory,
)
from imu_calibration.planning.planning_problem import PROBABILITY, PlanningProblem
from imu_calibration.planning.posterior import Posterior
from imu_calibration.references.gravity.advice import (
    HOLD_TIME,
    TURN_RATE,
    NoiseOfMeans,
    foretold,
    knowledge_at_first,
)
from imu_calibration.references.gravity.hand_parameters import HandModel
from imu_calibration.references.turntable.noise_model import NoiseModel, ReferenceNoise
from imu_calibration.references.turntable.requested_model import choose_model
from imu_calibration.simulation.motion_builder import MotionBuilder, Segment

MAX_PLAN_MOTIONS = 400
"""Motions of a plan at most."""
MARGIN_STEP = 1.02
"""
Factor on the standard deviations of the search, applied when they meet the goal and the exact
covariance does not.
"""
MIN_PLAN_GAIN = 2e-3
"""
Least reduction of the distance to the goal by a motion; near the goal the least share of the
distance.
"""


class CandidateMotions:
    """
    The gain of every motion from where the joints are.

    Parameters
    ----------
    problem : PlanningProblem
    posterior : Posterior
        After the motions so far.
    place : int
        Place where the joints are.
    margin : float
        Factor on the standard deviations.
    factor : float
        On the variance of the noise.

    """

    def __init__(
        self,
        problem: PlanningProblem,
        posterior: Posterior,
        place: int,
        *,
        margin: float = 1.0,
        factor: float = 1.0,
    ):
        self.places = problem.library.place_of
        """Place of each motion, shape (k,)."""
        self.seconds = problem.seconds + problem.move_seconds[place, self.places]
        """Length of each motion with the move to its place, s, shape (k,)."""
        self.information = (problem.information + problem.move_information(place)) / factor
        """Of each motion with the move, shape (k, m, m)."""
        self.possible = self.seconds > 0
        self._goal = problem.goal
        self._posterior = posterior
        self._margin = margin
        self.distance = float(problem.goal.distance(posterior.covariance_z[None], margin)[0])
        """Distance to the goal before the motion."""
        self.min_gain = MIN_PLAN_GAIN * min(1.0, self.distance)

    @cached_property
    def distance_after(self) -> np.ndarray:
        """Distance to the goal after each motion; mandatory motions are chosen without it."""
        size = self._posterior.size
        covariance = self._posterior.after(self.information, self.seconds)
        # Of the state, the first elements are z.
        return self._goal.distance(covariance[:, :size, :size], self._margin)

    @cached_property
    def gain(self) -> np.ndarray:
        """Reduction of the distance to the goal by each motion."""
        return np.where(self.possible, self.distance - self.distance_after, 0.0)

    def is_hopeless(self, number: int) -> bool:
        """Return whether a motion has almost no gain and does not reach the goal."""
        return bool(self.gain[number] < self.min_gain and self.distance_after[number] > 0)

    @property
    def best(self) -> int:
        """The motion with the largest gain per second."""
        gain_per_second = self.gain / np.maximum(self.seconds, 1e-9)
        return int(np.argmax(np.where(self.possible, gain_per_second, -np.inf)))


def greedy(
    problem: PlanningProblem, start: int, *, first: Sequence[int] = (), longest: float = np.inf
) -> list[int]:
    """
    Return motions that reach the goal, or the smallest distance to it.

    Each motion is the one with the best gain per second at its step.

    Parameters
    ----------
    problem : PlanningProblem
    start : int
        Place where the joints are.
    first : sequence of int
        Mandatory first motions.
    longest : float
        Time at most, s.

    """
    posterior = problem.posterior()
    place = start
    chosen = []
    spent = 0.0  # s
    margin = 1.0  # on the standard deviations of the search
    factor = 0.0  # on the variance of the noise; 0 before the first round
    # Of each chosen motion the information for a factor of 1, and the length, s.
    steps: list[tuple[np.ndarray, float]] = []
    first_distance = problem.goal.distance(posterior.covariance_z[None])[0]
    while len(chosen) < MAX_PLAN_MOTIONS and spent < longest:
        # 1. The factor falls with every rest: the motions so far then have more information, and
        #    their posterior is computed again.
        new_factor = problem.variance_factor(problem.timed(chosen, start).windows)
        if new_factor != factor:
            factor = new_factor
            posterior = problem.posterior()
            for information, seconds in steps:
                posterior.take(information / factor, seconds)

        # 2. The next motion: a mandatory one, or the best one if it has a gain and there is time.
        candidates = CandidateMotions(problem, posterior, place, margin=margin, factor=factor)
        if len(chosen) < len(first):
            number = first[len(chosen)]
        else:
            number = candidates.best
            if candidates.is_hopeless(number):
                break
            if spent + float(candidates.seconds[number]) > longest:
                break

        # 3. Its information and time are added.
        information = candidates.information[number]
        seconds = float(candidates.seconds[number])
        steps.append((factor * information, seconds))
        posterior.take(information, seconds)
        chosen.append(number)
        spent += seconds
        place = int(problem.library.place_of[number])

        # 4. End at the goal, if it is also reached by the exact covariance.
        distance = problem.goal.distance(posterior.covariance_z[None], margin)[0]
        report('planning', 1.0 - distance / max(first_distance, 1e-9), 1.0)
        if distance == 0.0 and len(chosen) >= len(first):
            if remaining_distance(problem, chosen, start) == 0.0:
                break
            # The posterior has constant biases within a motion, which was optimistic: the search
            # goes on to lower standard deviations.
            margin *= MARGIN_STEP
    return chosen


def remaining_distance(problem: PlanningProblem, sequence: Sequence[int], start: int) -> float:
    """Return the distance to the goal after motions from a place; 0 where they reach it."""
    covariance, _ = problem.covariance_after(sequence, start, cautious=True)
    return float(problem.goal.distance(covariance[None])[0])


def shortened_plan(
    problem: PlanningProblem, sequence: Sequence[int], start: int, *, fixed: int = 0
) -> list[int]:
    """
    Return a plan without the motions that do not reduce the distance to the goal.

    Each motion is tried in turn, the latest first, without the first `fixed` ones.
    """
    shortest = list(sequence)
    accepted = remaining_distance(problem, sequence, start) + 1e-9
    for index in range(len(shortest) - 1, fixed - 1, -1):
        trial = shortest[:index] + shortest[index + 1 :]
        if remaining_distance(problem, trial, start) <= accepted:
            shortest = trial
    return shortest


GOAL_REACHED = 'all that was wanted is reached'
STUCK = 'no motion within the limits reduces the remaining standard deviations'
MAX_BOUND_RATIO = 1.1
"""A plan this many times longer than the bound is searched again with other weights."""
MIN_RELATIVE_WEIGHT = 0.03
"""Least weight of a parameter in this search, as a share of the largest one."""


@dataclass(frozen=True, eq=False)
class Decision:
    """The next step: exactly one of a motion, a diagnosis and the end."""

    motion: PlannedMotion | None = None
    """Motion to be driven."""
    why: str = ''
    """Reason of the choice or of the end, one line."""
    seconds: float = 0.0
    """Length of the motion with the way to it, s."""
    diagnose: bool = False
    """Whether to diagnose."""


MAX_PRINTED_MOTIONS = 12
"""Motions of joints that are printed; plan.yaml has all."""


@dataclass(frozen=True, eq=False)
class Plan:
    """Consecutive motions and their predicted standard deviations."""

    model: SensorModel
    """Parameters to be determined."""
    motions: tuple[Any, ...]
    """PlannedMotion, by hand HandStep, in the order of time."""
    ends: np.ndarray
    """When each motion ends, the way to it included, s, shape (n_motions,)."""
    sd: np.ndarray
    """Predicted standard deviation of each parameter, SI, shape (n_params,)."""
    tolerances: np.ndarray
    """SI, shape (n_params,)."""
    wanted: np.ndarray
    """Whether each parameter is requested, shape (n_params,)."""
    history: np.ndarray
    """
    Standard deviations in tolerances before the first motion and after each, of the requested
    parameters, shape (n_motions + 1, k).
    """
    missing: tuple[str, ...]
    """Parameters outside their tolerance at the end, or pairs of causes that remain collinear."""
    start: np.ndarray | None = None
    """Where the joints are at the beginning, shape (n_joints,); None: by hand."""
    lower_bound_seconds: float = float('nan')
    """
    No plan made of these motions meets the tolerances in less, s; NaN where that was not worked
    out.
    """
    told_apart: str = ''
    """The causes that the plan separates, if that is its goal."""

    noun: str = 'motions'
    """Plural of its motions."""
    scope: str = 'for every motion of these joints within their limits'
    """Motions to choose from, in a sentence about what is out of reach."""
    most_printed: int | None = MAX_PRINTED_MOTIONS
    """Number of motions that are printed at most; None: all, for a person who makes them."""

    @property
    def moved_joints(self) -> tuple[str, ...]:
        """Names of the joints that move."""
        return tuple(self.model.joint_names) if self.motions else ()

    @property
    def seconds(self) -> float:
        """Total time, s."""
        return float(self.ends[-1]) if len(self.ends) else 0.0

    @property
    def segments(self) -> tuple[tuple[Segment, ...], ...]:
        """
        Segments of each motion, the way to it included, each going on where the last one ended.
        """
        position = np.asarray(self.start)
        all_segments = []
        for motion in self.motions:
            segments = motion.from_position(position)
            all_segments.append(segments)
            if segments:
                position = np.asarray(segments[-1].end)
        return tuple(all_segments)

    @property
    def points(self) -> TrajectoryPoints:
        """The whole plan as one trajectory."""
        segments = tuple(chain.from_iterable(self.segments))
        return trajectory(tuple(self.model.joint_names), segments)


class Planner:
    """
    Plans motions of one chain for one model.

    Parameters
    ----------
    problem : PlanningProblem
        Motions, model in tolerances, noise, earlier information.

    """

    def __init__(self, problem: PlanningProblem):
        self.problem = problem
        self._posterior = problem.posterior()
        """After the motions so far, by prediction or by the last calibration."""
        self._visited: set[int] = set()
        """Places of the rests so far."""
        self._first: list[int] | None = None
        """Mandatory next motions; None before they are chosen, from the first position."""

    def take(self, calibration: Calibration) -> None:
        """
        Replace the predicted covariance of the parameters that a calibration shares by its own.
        """
        names = {name: k for k, name in enumerate(calibration.param_names)}
        self.problem.known_information = self.problem.coordinates.information_from(
            names, calibration.covariance
        )
        self._posterior = self.problem.posterior()

    @property
    def excess(self) -> dict[str, float]:
        """Standard deviation over tolerance of each requested parameter, estimated or predicted."""
        coordinates = self.problem.coordinates
        excess = coordinates.excess(self._posterior.covariance_z).tolist()
        return dict(zip(coordinates.names, excess, strict=True))

    def next_motion(self, position: np.ndarray) -> Decision:
        """
        Return the motion with the largest gain per second from where the joints are.

        Its predicted information is added to that of the motions so far.
        """
        place = self.problem.place_near(position)
        if self._first is None:
            # After an earlier calibration no motion is mandatory.
            is_known = self.problem.known_information is not None
            self._first = [] if is_known else self.problem.first_rests(place)
        candidates = CandidateMotions(self.problem, self._posterior, place)
        if self._first:
            number = self._first.pop(0)
            reason = 'a session begins with rests in many attitudes'
        else:
            missing = self.problem.goal.missing(self._posterior.covariance_z)
            if not candidates.distance > 0:
                return Decision(why=STUCK if missing else GOAL_REACHED)
            number = candidates.best
            reason = f'it gains most per second for {", ".join(missing[:3])}'
            # Without any rest so far the first motion is made in any case.
            if self._visited and candidates.is_hopeless(number):
                return Decision(why=STUCK)
        self._posterior.take(candidates.information[number], float(candidates.seconds[number]))
        motion = self._visit(number)
        return Decision(motion, reason, motion.seconds_from(position))

    def probe(self, position: np.ndarray, reach: np.ndarray) -> PlannedMotion | None:
        """
        Return a motion of every joint to the wider side and back, None for zero.

        Each joint moves by at most `reach` (rad or m, shape (n_joints,)).
        """
        if not np.any(reach):
            return None
        library = self.problem.library
        limits = library.limits
        room_below = position - limits.lower
        room_above = limits.upper - position
        side = np.where(room_above >= room_below, 1.0, -1.0)
        excursion = side * np.clip(np.maximum(room_below, room_above), 0.0, reach)
        segments = (
            MotionBuilder(len(position), limits=limits, start=position)
            .move_to(position + excursion)
            .move_to(position)
            .segments
        )
        return library.motion(
            MotionKind.MOVE,
            np.asarray(position, float),
            segments,
            text='a small motion of every joint and back',
        )

    def unwinding(self, position: np.ndarray) -> PlannedMotion | None:
        """
        Return the move that turns wound joints back to the middle of their range, None for none.

        A joint is wound if the table has no end for it, the present limits have, and it is more
        than half a turn from the middle between them.
        """
        library = self.problem.library
        limits = library.limits
        is_restricted = limits_of(library.table).endless & ~limits.endless
        middle = np.where(is_restricted, 0.5 * (limits.lower + limits.upper), position)
        is_wound = np.abs(position - middle) > np.pi
        if not np.any(is_wound):
            return None
        target = np.where(is_wound, middle, position)
        # Without segments: only the move to its place.
        return library.motion(MotionKind.MOVE, target, (), text='unwinding')

    def plan(
        self,
        position: np.ndarray | None = None,
        *,
        with_bound: bool = True,
        longest: float = np.inf,
    ) -> Plan:
        """
        Return a plan from the present position to the goal.

        Parameters
        ----------
        position : ndarray, shape (n_joints,), optional
            Default: home.
        with_bound : bool
            Whether to work out the lower bound; a plan that is much longer is searched again.
        longest : float
            Time at most, s.

        """
        problem = self.problem
        start = problem.library.spread[0] if position is None else np.asarray(position, float)
        place = problem.place_near(start)
        # After an earlier calibration no motion is mandatory.
        first = () if problem.known_information is not None else problem.first_rests(place)
        self.drop_inseparable(longest)
        sequence = self._sequence(place, first, longest)
        bound = float('nan')
        if with_bound and isinstance(problem.goal, WithinTolerances):
            sequence, bound = self._bounded(sequence, place, first, longest)
        return self._plan_of(sequence, start, place, bound)

    def _bounded(
        self, sequence: list[int], place: int, first: Sequence[int], longest: float
    ) -> tuple[list[int], float]:
        """
        Return (plan, lower bound of its time in s) of `sequence`, or of a faster one.

        Where `sequence` is much longer than the bound, there is a second search. `place`, `first`
        and `longest` as for `_sequence`.
        """
        problem = self.problem
        timed = problem.timed(sequence, place)
        factor = problem.variance_factor(timed.windows)
        relaxed = problem.relaxation(factor=factor)
        bound = problem.lower_bound(factor=factor, relaxed=relaxed)
        # A bound of NaN has no second search: a tolerance is out of reach.
        if not timed.seconds > MAX_BOUND_RATIO * bound:
            return sequence, bound

        # In the second search the parameters that limit the relaxed plan count more.
        weights = np.maximum(relaxed.weights / relaxed.weights.max(), MIN_RELATIVE_WEIGHT)
        goal = problem.goal
        problem.goal = WithinTolerances(problem.coordinates, weights)
        second = self._sequence(place, first, longest)
        problem.goal = goal
        second_timed = problem.timed(second, place)
        reaches_goal = remaining_distance(problem, second, place) == 0.0
        if second_timed.seconds >= timed.seconds or not reaches_goal:
            return sequence, bound
        # Other rests: another factor on the noise, and with it another bound.
        factor = problem.variance_factor(second_timed.windows)
        return second, problem.lower_bound(factor=factor)

    def _sequence(self, place: int, first: Sequence[int], longest: float) -> list[int]:
        """
        Return the motions of the greedy search from a place, without needless ones.

        `first`: mandatory first motions; `longest`: time at most, s.
        """
        sequence = greedy(self.problem, place, first=first, longest=longest)
        return shortened_plan(self.problem, sequence, place, fixed=len(first))

    def drop_inseparable(self, seconds: float) -> None:
        """Drop pairs of causes that no plan of this time separates."""
        if isinstance(self.problem.goal, ToldApart) and np.isfinite(seconds):
            self.problem.goal.leave_out_of_reach(self.problem.best_covariance(seconds))

    def _plan_of(
        self, sequence: Sequence[int], start: np.ndarray, place: int, bound: float
    ) -> Plan:
        """
        Return the Plan of a sequence of motions, with its covariance after each of them.

        `start`: position of the joints, at the place `place`; `bound`: lower bound of the time, s.
        """
        problem = self.problem
        coordinates = problem.coordinates
        covariances = []
        ends = []
        for count in range(len(sequence) + 1):
            covariance, seconds = problem.covariance_after(sequence[:count], place)
            covariances.append(covariance)
            ends.append(seconds)
        cautious, _ = problem.covariance_after(sequence, place, cautious=True)
        self._visited.clear()
        return Plan(
            model=coordinates.model,
            motions=tuple(self._visit(number) for number in sequence),
            ends=np.array(ends[1:]),
            sd=coordinates.sd(covariances[-1]),
            tolerances=coordinates.tolerances,
            wanted=coordinates.wanted,
            history=coordinates.excess(np.array(covariances)),
            missing=problem.goal.missing(cautious),
            start=start,
            lower_bound_seconds=bound,
            told_apart=problem.goal.words,
        )

    def _visit(self, number: int) -> PlannedMotion:
        """
        Return a motion of the library; a rest at a place with an earlier rest is a return.

        The place of a rest is stored as visited.
        """
        motion = self.problem.motions[number]
        place = int(self.problem.library.place_of[number])
        if motion.kind is not MotionKind.POSE:
            return motion
        if place in self._visited:
            motion = replace(motion, kind=MotionKind.RETURN)
        self._visited.add(place)
        return motion


def make_planner(
    table: Table,
    *,
    noise: Mapping[str, NoiseModel],
    tolerances: dict | None = None,
    rate: float = 100.0,
    options: CalibrationOptions = CalibrationOptions(),
    limits: MotionLimits | None = None,
    calibration: Calibration | None = None,
) -> Planner:
    """
    Return the planner of a table or an arm.

    Parameters
    ----------
    table : Table
    noise : mapping
        Sensor -> NoiseModel of single samples at `rate`, see `noise_of_grade`; encoder steps are
        those of the table.
    tolerances : mapping, optional
        {section: {effect: tolerance}}, SI.
    rate : float
        Samples of the IMU per second.
    options : CalibrationOptions
        Model to be estimated.
    limits : MotionLimits, optional
        Default: the limits of the table.
    calibration : Calibration, optional
        Prior calibration.

    """
    model = choose_model(options, table)
    values = None
    if calibration is not None:
        values = model.start_from(calibration.model, calibration.values)
    coordinates = Coordinates(model, tolerances_of(model, tolerances or options.tolerances), values)
    encoder_step = table.joint_noise_rad or 0.0
    with_encoders = {}
    for sensor, sensor_noise in noise.items():
        reference = ReferenceNoise.of_steps(encoder_step, sensor)
        with_encoders[sensor] = replace(sensor_noise, reference=reference)
    library = MotionLibrary(table, limits)
    planner = Planner(PlanningProblem(library, coordinates, with_encoders, rate=rate))
    if calibration is not None:
        planner.take(calibration)
    return planner


def plan_by_hand(
    model: HandModel, *, tolerances: np.ndarray, noise: Mapping[str, NoiseModel], rate: float
) -> Plan:
    """
    Return the poses and turns that bring every parameter within its tolerance.

    Each of them has the largest gain per second of all that could be next.

    Parameters
    ----------
    model : HandModel
    tolerances : ndarray, shape (n,)
    noise : mapping
        Sensor -> NoiseModel of single samples.
    rate : float
        Samples per second.

    """
    # The integral of the rates over a turn of half a revolution: its variance is that of a sample
    # times the seconds of the turn over the samples per second.
    turn_seconds = np.pi / TURN_RATE
    turn_variance = noise['gyroscope'].low_variance.mean() * turn_seconds / rate
    noise_of_means = NoiseOfMeans(
        force=_mean_sd(noise['accelerometer'], HOLD_TIME * rate),
        rate=_mean_sd(noise['gyroscope'], HOLD_TIME * rate),
        turn=float(np.sqrt(turn_variance)),
    )
    knowledge = knowledge_at_first(model, tolerances, noise=noise_of_means)
    steps = foretold(knowledge)
    history = [knowledge.sd(knowledge.information)]
    for step in steps:
        knowledge = knowledge.then(step)
        history.append(knowledge.sd(knowledge.information))
    wanted = ~model.fixed
    missing = np.array(model.model.param_names)[wanted & (history[-1] > tolerances)].tolist()
    return Plan(
        model=model.model,
        motions=tuple(steps),
        ends=np.cumsum([step.seconds for step in steps]),
        sd=history[-1],
        tolerances=tolerances,
        wanted=wanted,
        history=np.array(history)[:, wanted] / tolerances[wanted],
        missing=tuple(missing),
        noun='poses and turns',
        scope='by hand',
        most_printed=None,
    )


PLAN_FORMAT = 'imu_calibration/plan/1'


def plan_to_mapping(plan: Plan, provenance: dict[str, Any]) -> dict[str, Any]:
    """
    Return the content of plan.yaml: plain data in SI, except angles of joints in degrees, named so.
    """
    begins = [0.0, *plan.ends.tolist()]
    only_with_joints: dict[str, Any] = {}
    if plan.start is not None:
        only_with_joints = {'probability': PROBABILITY, 'joints': list(plan.moved_joints)}
    bound = None if np.isnan(plan.lower_bound_seconds) else round(plan.lower_bound_seconds, 3)
    return {
        'format': PLAN_FORMAT,
        'seconds': round(plan.seconds, 3),
        'lower_bound_seconds': bound,
        **only_with_joints,
        'motions': [
            {
                'kind': str(motion.kind),
                'text': motion.words,
                'begins': round(begin, 3),
                'ends': round(end, 3),
                'seconds': round(motion.seconds, 3),
                **motion.details,
            }
            for motion, begin, end in zip(plan.motions, begins[:-1], begins[1:], strict=True)
        ],
        'parameters': {
            name: {
                'sd': float(f'{plan.sd[k]:.6g}'),
                'tolerance': float(f'{plan.tolerances[k]:.6g}'),
                'met': name not in plan.missing,
            }
            for k, name in enumerate(plan.model.param_names)
            if plan.wanted[k]
        },
        'missing': list(plan.missing),
        'provenance': provenance,
    }


def _mean_sd(noise: NoiseModel, n_samples: float) -> float:
    """Return the sd of a mean of samples: sqrt(white variance / n + variances of the biases)."""
    wander = sum(process.sd**2 for process in noise.bias_processes)
    return float(np.sqrt(noise.low_variance.mean() / n_samples + wander))


def trajectory_to_mapping(points: TrajectoryPoints) -> dict[str, Any]:
    """
    Return the fields of trajectory_msgs/JointTrajectory as ``ros2 topic pub`` reads them.
    """
    columns = {
        'positions': points.position,
        'velocities': points.rate,
        'accelerations': points.acceleration,
    }
    rows = []
    for k, time in enumerate(points.time):
        seconds, nanoseconds = divmod(round(float(time) * 1e9), 1_000_000_000)
        row: dict[str, Any] = {}
        for name, values in columns.items():
            if values is not None:
                row[name] = [float(f'{value:.9g}') for value in values[k]]
        row['time_from_start'] = {'sec': seconds, 'nanosec': nanoseconds}
        rows.append(row)
    return {'joint_names': list(points.joint_names), 'points': rows}
