"""
Evidence of one pass over a recording for its checks, and checks of messages.

The checks of messages are of the header and covariance of single messages.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import chain
from typing import Any

import numpy as np

from imu_calibration.core.readings import RawReadings
from imu_calibration.core.samples import ImuSamples
from imu_calibration.core.text_enum import StrEnum
from imu_calibration.preprocessing import scan
from imu_calibration.preprocessing.dead_band import DeadBandSearch
from imu_calibration.preprocessing.full_scale import (
    Extremes,
    Turning,
    factor_between_rests,
    relate_turns,
)
from imu_calibration.preprocessing.stream_cleaning import CleanedBlock, StreamStatistics

MIN_MOVING_STEPS = 50.0
"""A constant axis is frozen if another axis moves by this many steps of the converter."""


@dataclass(frozen=True, eq=False)
class RecordingEvidence:
    """Quantities of a recording, cleaned and in SI, from which its checks decide."""

    streams: dict[str, StreamStatistics]
    """'imu', 'joints', 'temperature' -> rates, gaps, drops; only streams with accepted samples."""
    chunks: scan.Chunks
    """Readings of the IMU in short chunks."""
    n_samples: int
    """IMU samples that were checked."""
    n_changed: np.ndarray
    """How often each of force x, y, z, rate x, y, z differs from the sample before, shape (6,)."""
    n_repeated: int
    """Samples with all readings equal to those of the previous sample."""
    resolution: np.ndarray
    """Smallest step between readings of each column, shape (6,); 0 when unknown."""
    ends: tuple
    """Extremes of each column, (upwards, downwards) six times."""
    temperature_c: tuple | None
    """Lowest and highest temperature."""
    gravity: float
    """Local gravity, m/s^2."""
    still_joints_ns: np.ndarray
    """First and last stamp of each stretch in which no joint position changes, shape (n, 2)."""
    readings: RawReadings = RawReadings()
    """Stated units, from which the readings were converted to SI."""
    dead_band: np.ndarray = field(default_factory=lambda: np.zeros(3))
    """Threshold below which rates are given as zero, rad/s, shape (3,); 0 without."""

    @property
    def absent(self) -> tuple[str, ...]:
        """Sensors without readings; their columns in `chunks` have no meaning."""
        imu = self.streams.get('imu')
        return () if imu is None else imu.absent

    @cached_property
    def frozen(self) -> dict[str, np.ndarray]:
        """Sensor -> whether it repeats one reading in each chunk, bool, shape (n,)."""
        return scan.frozen_chunks(self.chunks, self.resolution)

    @cached_property
    def awake(self) -> scan.Chunks:
        """The chunks in which no sensor is frozen."""
        return self.chunks.select(~np.logical_or(*self.frozen.values()))

    @cached_property
    def frozen_parts(self) -> list[scan.FrozenPart]:
        """Stretches in which a sensor is frozen, or the joints are while the IMU turns."""
        rate = np.zeros(3) if self.rest is None else self.rest.rate
        return scan.frozen_parts(self.chunks, self.frozen) + scan.frozen_joints(
            self.awake, self.still_joints_ns, rate
        )

    @cached_property
    def rest(self) -> scan.Rest | None:
        """Readings while steady, or None."""
        return scan.find_rest(self.awake)

    @cached_property
    def turning(self) -> Turning | None:
        """Relation of the rates to the rotation of gravity, or None."""
        return relate_turns(self.awake)

    @cached_property
    def rate_factor(self) -> float | None:
        """Ratio of measured rates to the rates that turn gravity from rest to rest, or None."""
        return factor_between_rests(self.awake, self.rest)

    @cached_property
    def quiet_range(self) -> np.ndarray:
        """Largest minus smallest reading in a quiet chunk, shape (6,)."""
        if self.rest is not None:
            return self.rest.range
        return np.quantile(self.awake.range, 0.1, axis=0) if len(self.awake) else np.zeros(6)

    @cached_property
    def stuck(self) -> np.ndarray:
        """
        Chunks in which one axis is constant while another one of its sensor moves, shape (n, 6).

        An axis with constant readings in quiet chunks has no known noise, and no such chunk.
        """
        stuck = np.zeros(self.chunks.range.shape, bool)
        for columns in scan.SENSOR_COLUMNS.values():
            moving = self.chunks.range[:, columns] > MIN_MOVING_STEPS * self.resolution[columns]
            for axis, column in enumerate(range(columns.start, columns.stop)):
                if self.quiet_range[column] == 0:
                    continue
                other_moves = np.delete(moving, axis, axis=1).any(axis=1)
                same = (self.chunks.range[:, column] == 0) & ~self._at_end(column)
                stuck[:, column] = scan.in_long_runs(same & other_moves)
        return stuck

    def _at_end(self, column: int) -> np.ndarray:
        """Return in which chunks an output is at a clipping limit: clipped, not frozen."""
        mean = self.chunks.mean[:, column]
        at_end = np.zeros(len(mean), bool)
        for sign, end in zip((1, -1), self.ends[column], strict=True):
            if end.n_clipped:
                at_end |= np.isclose(sign * mean, end.level, rtol=1e-9)
        return at_end

    @cached_property
    def force_length(self) -> Any:
        """
        Length of the specific force at rest, else its median length, m/s^2; None without samples.
        """
        if self.rest is not None:
            return self.rest.length
        if not len(self.chunks):
            return None
        return float(np.median(np.linalg.norm(self.chunks.mean[:, :3], axis=1)))


class EvidenceGatherer:
    """Computes the `RecordingEvidence` from cleaned blocks."""

    def __init__(self, gravity: float):
        self.gravity = gravity
        """Local gravity, m/s^2."""
        self._chunks = scan.ChunkSeries()
        # Of each column: largest readings upwards, and downwards with the other sign.
        self._ends = tuple((Extremes(), Extremes()) for _ in range(6))
        self._resolution = scan.ResolutionSearch()
        self._joints = scan.StandingJoints()
        # Lowest and highest temperature.
        self._temperature_c: tuple[float, float] | None = None
        self._dead_band = DeadBandSearch()

    def push(self, cleaned: CleanedBlock) -> None:
        """Process a CleanedBlock."""
        for _, imu in cleaned.imu:
            self.push_imu(imu)
        for _, joints in cleaned.joints:
            self._joints.push(joints.stamp_ns, joints.position)
        for _, temperature in cleaned.temperature:
            low, high = self._temperature_c or (np.inf, -np.inf)
            self._temperature_c = (
                min(low, float(temperature.temperature_c.min())),
                max(high, float(temperature.temperature_c.max())),
            )

    def evidence(
        self, statistics: dict[str, StreamStatistics], readings: RawReadings
    ) -> RecordingEvidence:
        """Return the RecordingEvidence, with the StreamStatistics of each stream."""
        resolution = self._resolution.result()
        return RecordingEvidence(
            streams={name: stream for name, stream in statistics.items() if stream.count},
            chunks=self._chunks.chunks(),
            n_samples=self._chunks.n_samples,
            n_changed=self._chunks.n_changed,
            n_repeated=self._chunks.n_repeated,
            resolution=resolution,
            ends=self._ends,
            temperature_c=self._temperature_c,
            gravity=self.gravity,
            still_joints_ns=self._joints.stretches(),
            readings=readings,
            dead_band=self._dead_band.bands(resolution[3:]),
        )

    def push_imu(self, imu: ImuSamples) -> None:
        """Process IMU samples in SI."""
        columns = np.concatenate([imu.force_s.T, imu.rate_s.T])
        self._resolution.push(columns.T)
        self._chunks.push(imu.stamp_ns, columns)
        self._dead_band.push(columns[3:])
        for column, (upwards, downwards) in zip(columns, self._ends):
            upwards.push(column)
            downwards.push(-column)


class Severity(StrEnum):
    """Consequence of a finding for the result, the worst first."""

    REFUSE = 'refuse'
    """The result would be wrong."""
    WARNING = 'warning'
    """The result may be less accurate."""
    NOTE = 'note'
    """A property of the recording."""
    GOOD = 'good'
    """Checked and in order."""


REFUSE, WARNING, NOTE, GOOD = Severity


@dataclass(frozen=True)
class CheckFinding:
    """One line about a recording."""

    check: str
    """Name of the check."""
    severity: Severity
    """Its consequence."""
    text: str
    """Requirement, received value and remedy; for GOOD, the observation."""
    samples: int = 0
    """Samples that are unusable because of it and not counted elsewhere."""
    key: str | None = None
    """The missing input, a key of `errors.ERROR_KEYS`."""
    value: str = ''
    """Proposed value of the missing input."""
    sensor: str = ''
    """The sensor that cannot be used while the other one can; or `checks.JOINT_STATES`."""

    def named(self, name: str) -> 'CheckFinding':
        """Return the finding with the name of its recording before the text."""
        return replace(self, text=f'{name}: {self.text}')

    def to_mapping(self) -> dict:
        """Return the entry for the calibration file."""
        return {
            'check': self.check,
            'severity': self.severity,
            'text': self.text,
            'samples': self.samples,
        }


OLD = 0.5
"""s; transforms and filters drop older messages, and the delay of a driver is much smaller."""
ABSENT_MARK = -1.0
"""First element of a covariance: the message does not have that quantity (sensor_msgs/Imu)."""
MESSAGE_QUANTITIES = ('specific force', 'angular rate', 'orientation')
"""Quantities of a message with a covariance."""
LARGEST_ASYMMETRY = 1e-6
"""Share of the largest variance; rounding errors are much smaller."""


@dataclass(frozen=True, eq=False)
class MessageEvidence:
    """Contents of the messages of one topic other than readings."""

    frame_ids: dict[str, int] = field(default_factory=dict)
    """frame_id -> messages."""
    covariances: dict[str, np.ndarray] = field(default_factory=dict)
    """
    'specific force', 'angular rate', 'orientation' -> covariance of the last message, shape (3, 3),
    SI.
    """
    orientation: np.ndarray | None = None
    """Quaternion x, y, z, w of the last message, shape (4,)."""
    age: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """
    Arrival minus stamp by the clock of this computer, s, shape (n,); messages without a stamp are
    left out.
    """


def with_findings_of(
    check: str, new: Iterable[CheckFinding], findings: Iterable[CheckFinding]
) -> tuple[CheckFinding, ...]:
    """Return findings in which those of one check are replaced by new ones, which are first."""
    return (*new, *(finding for finding in findings if finding.check != check))


def check_messages(evidence: MessageEvidence) -> tuple[CheckFinding, ...]:
    """Return the findings in `MessageEvidence`; empty without messages."""
    if not evidence.frame_ids:
        return ()
    checks = (frame, covariance, orientation, age)
    return tuple(chain.from_iterable(check(evidence) for check in checks))


def frame(evidence: MessageEvidence) -> Iterator[CheckFinding]:
    """Every message names its frame, the same one."""
    names = sorted(evidence.frame_ids)
    if '' in names:
        yield CheckFinding(
            'frame',
            WARNING,
            f'messages must name their frame, {evidence.frame_ids[""]} of'
            f' {sum(evidence.frame_ids.values())} have an empty frame_id: they cannot be'
            " transformed; set the driver's frame_id, usually imu_link",
        )
    if len(names) > 1:
        yield CheckFinding(
            'frame',
            WARNING,
            'messages of one topic must be of one sensor, frame_ids are '
            + ', '.join(f"'{name}'" for name in names)
            + '; give each sensor a topic of its own',
        )
    elif names[0]:
        yield CheckFinding('frame', GOOD, f"frame_id '{names[0]}'")


def covariance(evidence: MessageEvidence) -> Iterator[CheckFinding]:
    """
    Covariances are unknown (zeros), absent (-1) or covariances: finite, symmetric, not negative.
    """
    for name, matrix in evidence.covariances.items():
        if matrix[0, 0] == ABSENT_MARK:
            if name != 'orientation':
                yield CheckFinding(
                    'covariance',
                    NOTE,
                    f'the covariance marks the {name} in these messages as absent (-1)',
                )
            continue
        variances = np.diag(matrix)
        atol = LARGEST_ASYMMETRY * np.abs(matrix).max()
        if not np.isfinite(matrix).all() or (variances < 0).any():
            yield CheckFinding(
                'covariance',
                WARNING,
                f'variances of the {name} must be finite and not negative, they are'
                f' {_numbers(variances)}; filters that believe them diverge: correct the'
                ' driver, or fill them with compensator_node',
            )
        elif not matrix.any():
            if name != 'orientation':
                yield CheckFinding(
                    'covariance',
                    NOTE,
                    f'the covariance of the {name} is unknown (zeros): estimators need it; '
                    'compensator_node fills it',
                )
        elif not np.allclose(matrix, matrix.T, rtol=0, atol=atol):
            yield CheckFinding(
                'covariance',
                WARNING,
                f'the covariance of the {name} must be symmetric, it is not; correct the driver',
            )
        elif not variances.all():
            yield CheckFinding(
                'covariance',
                WARNING,
                f'variances of the {name} must be greater than zero, they are'
                f' {_numbers(variances)}: a filter would treat these axes as exact; correct'
                ' the driver',
            )
        else:
            yield CheckFinding(
                'covariance',
                GOOD,
                f'standard deviations of the {name}: {_numbers(np.sqrt(variances))}',
            )


def orientation(evidence: MessageEvidence) -> Iterator[CheckFinding]:
    """An orientation is a unit quaternion, or marked as absent."""
    given = evidence.covariances.get('orientation')
    if evidence.orientation is None or given is None or given[0, 0] == ABSENT_MARK:
        return
    size = float(np.linalg.norm(evidence.orientation))
    if not abs(size - 1) < 0.01:
        yield CheckFinding(
            'orientation',
            WARNING,
            f'an orientation must be a unit quaternion, its length is {size:.3g}: set '
            'orientation_covariance[0] to -1 where the sensor gives none (REP 145)',
        )
    elif not given.any() and np.array_equal(np.abs(evidence.orientation), [0, 0, 0, 1]):
        yield CheckFinding(
            'orientation',
            NOTE,
            'the orientation is the identity with an unknown covariance: set '
            'orientation_covariance[0] to -1 where the sensor gives none (REP 145)',
        )


def age(evidence: MessageEvidence) -> Iterator[CheckFinding]:
    """Stamps are close to this computer's clock."""
    if not len(evidence.age):
        return
    median = float(np.median(evidence.age))
    if abs(median) > OLD:
        yield CheckFinding(
            'age',
            WARNING,
            f'stamps must agree with the clock of this computer within {OLD} s, they are'
            f' {abs(median):.3g} s {"behind" if median > 0 else "ahead of"} it: transforms and'
            ' filters drop such messages; synchronise the clocks, or for a recording play /clock'
            ' and set use_sim_time',
        )
    else:
        yield CheckFinding(
            'age', GOOD, f'stamps are {1e3 * median:.1f} ms old when messages are received'
        )


def _numbers(values: np.ndarray) -> str:
    """Return numbers with three digits, separated by commas."""
    return ', '.join(f'{value:.3g}' for value in values)
