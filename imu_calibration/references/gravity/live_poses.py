"""
Live calibration by hand.

Poses, attitudes and turns are counted, the missing motion is reported, the result is that of a
recording.
"""

from __future__ import annotations

import copy
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from imu_calibration.calibration.coverage import (
    DIRECTIONS,
    Coverage,
    GroupState,
    Progress,
    Step,
    is_done,
    waiting_groups,
)
from imu_calibration.calibration.live import (
    LiveByHandSettings,
    LiveSession,
    LiveSettings,
    SolvePacer,
)
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.core.errors import InputError, NotObservableError, with_hint
from imu_calibration.core.progress import LiveState
from imu_calibration.core.samples import ImuSamples, SampleBlock
from imu_calibration.core.units import STANDARD_GRAVITY
from imu_calibration.document.calibration import Calibration
from imu_calibration.document.outcome import parameter_count
from imu_calibration.effects.base import SENSORS
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.solution import (
    COMMON_SCALE,
    GRAVITY,
    NO_STEP,
    REMEDIES,
    REMEDY_KEYS,
    tolerances_of,
)
from imu_calibration.kinematics.rotations import unit_rows
from imu_calibration.preprocessing.absent_sensor import without_sensor
from imu_calibration.preprocessing.checks import frozen_text
from imu_calibration.preprocessing.rest_detection import find_still
from imu_calibration.preprocessing.sample_recording import SampleRecording, late_gyroscope
from imu_calibration.preprocessing.sensor_join import delay_of
from imu_calibration.preprocessing.stamping import StampLine
from imu_calibration.preprocessing.stream_cleaning import StreamCheck
from imu_calibration.preprocessing.window import WindowSettings
from imu_calibration.references.gravity.advice import (
    HandKnowledge,
    foretold,
    knowledge_after,
    knowledge_at_first,
    ups_of,
)
from imu_calibration.references.gravity.equations import Poses, TurnData
from imu_calibration.references.gravity.hand_calibration import MIN_ATTITUDES, POSES_FULL
from imu_calibration.references.gravity.hand_parameters import HandModel, HandOptions, hand_options
from imu_calibration.references.gravity.hand_workflow import calibrate_poses
from imu_calibration.references.gravity.pose_observations import HandResult, PoseObservations
from imu_calibration.references.gravity.poses import (
    average_poses,
    collect_turns,
    distinct_attitudes,
)
from imu_calibration.references.gravity.sample_store import HandStore

FACE_DIRECTIONS = dict(
    zip(('+x', '-x', '+y', '-y', '+z', '-z'), np.kron(np.eye(3), [[1.0], [-1.0]]))
)
"""The six directions that can be turned up."""
FACE_REACH = np.pi / 4
"""A face counts as seen when an attitude lies within this angle of it, rad."""


@dataclass(frozen=True, eq=False)
class PoseScan:
    """Result of the search for rest in the samples so far."""

    rests: list[slice]
    """Ranges of samples at rest."""
    poses: Poses | None
    """Means over the rests; None without any rest."""
    attitudes: int
    """Number of different attitudes."""
    turns: int
    """Number of usable turns between consecutive poses."""
    dropped: dict[str, int]
    """Reason -> number of unusable turns."""
    resting: float
    """Duration of the current rest, s; 0 in motion."""
    absent: tuple[str, ...] = ()
    """Sensors without readings."""


EMPTY_SCAN = PoseScan(rests=[], poses=None, attitudes=0, turns=0, dropped={}, resting=0.0)


def look_for_poses(imu: ImuSamples, windows: WindowSettings) -> PoseScan:
    """Return the PoseScan in ImuSamples with rising stamps."""
    rests = [rest for rest in find_still(imu, windows) if rest.stop - rest.start >= 2]
    if not rests:
        return EMPTY_SCAN
    seconds = 1e-9 * (imu.stamp_ns - imu.stamp_ns[0])
    poses = average_poses(imu, [(rest.start, rest.stop) for rest in rests])
    turns: list[TurnData] = []
    dropped: dict[str, int] = {}
    if not imu.absent:  # a turn relates both sensors
        turns, dropped = collect_turns(seconds, imu, poses=poses)
    resting = 0.0
    # The last rest still lasts where hardly any motion follows it.
    if seconds[-1] - seconds[rests[-1].stop - 1] <= 0.1:
        resting = float(seconds[-1] - seconds[rests[-1].start])
    return PoseScan(
        rests=rests,
        poses=poses,
        attitudes=distinct_attitudes(poses.force),
        turns=len(turns),
        dropped=dropped,
        resting=resting,
        absent=imu.absent,
    )


def hand_status(
    scan: PoseScan,
    calibration: Calibration | None,
    *,
    step: str,
    hints: dict[str, str] | None = None,
) -> LiveState:
    """
    Return the LiveState of a session by hand: counts of poses and turns, and what to do next.

    Parameters
    ----------
    scan : PoseScan
    calibration : Calibration or None
        The last solution.
    step : str
        Next step in the planner's text (`advice`), '' when no pose has a gain.
    hints : dict, optional
        As for `errors.with_hint`.

    """
    unseen_faces = unseen(scan)
    progress, needs = _needs(scan, unseen_faces, calibration, step=step, hints=hints or {})
    values = {
        'poses': len(scan.rests),
        'attitudes': scan.attitudes,
        'turns': scan.turns,
        **{f'turns left out: {reason}': count for reason, count in scan.dropped.items()},
        'directions of gravity not seen': ' '.join(unseen_faces),
        'at rest for [s]': f'{scan.resting:.1f}',
        'next': '; '.join(needs),
    }
    parts = [
        f'{_plural(len(scan.rests), "pose")} in {_plural(scan.attitudes, "attitude")},'
        f' {_plural(scan.turns, "turn")}'
    ]
    if scan.dropped:
        counts = [f'{count} {reason}' for reason, count in sorted(scan.dropped.items())]
        parts.append('turns left out: ' + ', '.join(counts))
    if scan.resting:
        parts.append(f'at rest for {scan.resting:.1f} s: this pose counts, move on')
    parts += [f'next: {need}' for need in needs]
    if not needs:
        parts.append('all parameters are determined: save the calibration')
    return LiveState(progress, '; '.join(parts), values)


def unseen(scan: PoseScan) -> list[str]:
    """
    Return the faces ('+x', ...) that have not been up, the one furthest from all attitudes first.
    """
    if 'accelerometer' in scan.absent:
        return []
    if scan.poses is None:
        return list(FACE_DIRECTIONS)
    up = unit_rows(scan.poses.force)
    nearest = {}  # face -> smallest angle to an attitude, rad
    for name, face in FACE_DIRECTIONS.items():
        nearest[name] = float(np.arccos(np.clip(up @ face, -1, 1)).min())
    unseen_faces = [name for name, angle in nearest.items() if angle > FACE_REACH]
    return sorted(unseen_faces, key=lambda name: -nearest[name])


def _needs(
    scan: PoseScan,
    unseen_faces: Sequence[str],
    calibration: Calibration | None,
    *,
    step: str,
    hints: dict[str, str],
) -> tuple[Progress, list[str]]:
    """Return (progress, texts of the next steps or remedies); arguments as for `hand_status`."""
    if 'accelerometer' in scan.absent:
        # Gravity is not measured: one rest determines the bias, and no turn the matrix.
        if calibration is None:
            return Progress.WAITING, ['hold it still']
        if not parameter_count(calibration).lacking:
            return Progress.DETERMINED, []
        return Progress.WEAK, needs_of(calibration)
    if scan.attitudes < MIN_ATTITUDES or calibration is None:
        faces = f' (faces not seen yet: {", ".join(unseen_faces)})' if unseen_faces else ''
        return Progress.WAITING, [
            f'{step}{faces}; {MIN_ATTITUDES} attitudes at least, {POSES_FULL} for all parameters'
        ]
    if not parameter_count(calibration).lacking:
        return Progress.DETERMINED, []
    needs = needs_of(calibration)
    without_motion = []
    for need in needs:
        if need in NO_STEP:
            without_motion.append(with_hint(need, REMEDY_KEYS.get(need), hints))
    if len(without_motion) == len(needs) > 0:
        return Progress.WEAK, without_motion
    # The planned step serves the parameters whose need is a pose or a turn.
    return Progress.WEAK, [step, *without_motion] if step else needs


def needs_of(calibration: Calibration) -> list[str]:
    """
    Return the needs of the undetermined parameters, each once.

    If only the common scale is undetermined, it needs the local gravity.
    """
    if parameter_count(calibration).lacking == (COMMON_SCALE,):
        return [REMEDIES[GRAVITY,]]
    return list(dict.fromkeys(item['needs'] for item in calibration.undetermined))


def _plural(count: int, noun: str) -> str:
    """Return '1 pose', '2 poses'."""
    return f'{count} {noun}' + ('' if count == 1 else 's')


def knowledge_of(scan: PoseScan, result: HandResult | None, options: HandOptions) -> HandKnowledge:
    """
    Return the HandKnowledge of a session.

    It follows from the last solution, before the first solution from the poses so far.
    """
    if result is not None:
        return knowledge_after(result.applied)
    model = HandModel(options.model, options.gravity)
    return knowledge_at_first(
        model, tolerances_of(model.model, options.tolerances), poses=scan.poses
    )


def hand_coverage(
    scan: PoseScan, result: HandResult | None, options: HandOptions, *, frame_id: str = ''
) -> Coverage:
    """
    Return the Coverage of a session by hand.

    It has the gain of each direction, the next pose with the turn to it, and the remaining seconds.
    """
    without_gravity = 'accelerometer' in scan.absent
    seen = ups_of(None if without_gravity else scan.poses)
    no_gain = Coverage(
        worth=np.zeros(len(DIRECTIONS)),
        seen=seen,
        up=seen[-1] if len(seen) else None,
        next=Step(''),
        seconds=0.0,
        frame_id=frame_id,
    )

    # No attitude has a gain: all is determined, or each need is an input or a cause to be found,
    # the keys of `REMEDY_KEYS`, or gravity is not measured. `MOVED_REMEDY` is none of these keys: a
    # sensor that moved at rest is put down again, in the attitude that the picture shows.
    if result is not None:
        if is_done(result):
            return replace(no_gain, done=True)
        needs = needs_of(result.calibration)
        if needs and set(needs) <= set(REMEDY_KEYS):
            return replace(no_gain, next=Step(needs[0]))
    if without_gravity:
        return no_gain

    # The plan of the remaining steps.
    knowledge = knowledge_of(scan, result, options)
    steps = foretold(knowledge)
    if not steps:
        return no_gain
    first = steps[0]
    return replace(
        no_gain,
        worth=knowledge.best().gains,
        next=Step(first.words, first.up, first.axis, first.angle),
        seconds=sum(step.seconds for step in steps),
    )


SEARCH_SHARE = 0.05
"""
Largest share of time for the search for rest: after an hour at 200 Hz a search runs every ten
seconds or so.
"""
SEARCH_STEP = 0.5
"""Least duration of new samples between searches for rest, s."""
_FIRST_NEEDS = {
    'accelerometer': f'hold it still in {POSES_FULL} different attitudes',
    'gyroscope': 'turn it from one attitude to the next, within half a minute',
}
MAX_LIVE_POSES = 200
"""
The computation time grows with the third power of the number of poses; the oldest are discarded.
"""


class LiveByHand(LiveSession):
    """
    One live session without a table: `push` arriving samples, `solve` when due.

    The samples are cleaned, searched and solved by the functions for recordings, and all are kept
    up to the memory limit: the result equals `calibrate` on the same samples. Beyond
    the limit (`hand_samples`) it is the result for the kept samples. A clock reset, for which a
    recording is refused, is treated as a pause.

    Parameters
    ----------
    options : CalibrationOptions
        Requested model and reference.
    settings : LiveSettings
    by_hand : LiveByHandSettings
    saved : bytes, optional
        Return value of `saved` in an earlier run.
    clock : callable
        Seconds of a monotonic clock.

    Raises
    ------
    InputError
        When a requested effect needs a table, or temperatures.

    """

    def __init__(
        self,
        options: CalibrationOptions,
        settings: LiveSettings,
        by_hand: LiveByHandSettings = LiveByHandSettings(),
        *,
        saved: bytes | None = None,
        clock: Callable[[], float] = time.monotonic,
    ):
        self.options = by_hand.at_place(options)
        self.settings = settings
        self._clock = clock
        # Options at the start; the gravity of `options` may change later.
        self._first_options = hand_options(self.options)
        _check_model(self.model)
        self._check = StreamCheck(one_sensor=True)
        self._store = HandStore(by_hand.hand_samples)
        # Reason -> number of samples that the source could not use; `_check` counts its own.
        self._drops = Counter()
        if saved is not None:
            self._store.load(saved)
        # Decides when the next search for rest is due.
        self._pacer = SolvePacer(SEARCH_SHARE)
        # Number of samples since the last search.
        self._n_unsearched = 0
        # Stamp of the end of the last rest that `push` has returned; None before the first.
        self._reported_ns: int | None = None
        # The last Coverage, with the (scan, result, gravity) from which it was computed.
        self._last_coverage: tuple[tuple, Coverage] | None = None
        # Result of the last search.
        self.scan = EMPTY_SCAN
        self.result: HandResult | None = None
        self._search(self._store)

    @property
    def model(self) -> SensorModel:
        """The requested model; effects that a solution adds are not in it."""
        return self._first_options.model

    observations = PoseObservations.unit
    needs_joints = False

    @property
    def frame_id(self) -> str:
        """Frame of the sensor; '' before the first message."""
        imu = self._store.samples()
        return '' if imu is None else imu.frame_id

    def change(self, settings: LiveSettings | WindowSettings | LiveByHandSettings) -> bool:
        """
        Use other settings from now on; return whether the poses have to be solved again.

        `WindowSettings` apply to all stored samples, `LiveByHandSettings` have the gravity and the
        largest number of samples.
        """
        if isinstance(settings, LiveSettings):
            self.settings = settings
            return False
        if isinstance(settings, WindowSettings):
            self.options = replace(self.options, windows=settings)
            self._search(self._store)
            return False
        self.options = settings.at_place(self.options)
        self._store.most = settings.hand_samples
        return True

    @property
    def n_windows(self) -> int:
        """Poses at the last search."""
        return len(self.scan.rests)

    @property
    def n_covered(self) -> int:
        """Poses at the last search."""
        return self.n_windows

    @property
    def stamping(self) -> StampLine | None:
        """Regularity of the IMU stamps (`stamping.StampLine`); None while unknown."""
        return self._check.line

    @property
    def counts(self) -> dict[str, int]:
        """Unusable samples, by reason."""
        of_stream = {f'imu {reason}': count for reason, count in self._check.counts.items()}
        return dict(self._drops + Counter(of_stream))

    def push(self, block: SampleBlock) -> list[ImuSamples]:
        """
        Add arriving samples; return the mean reading of each pose completed since the last call.
        """
        self._drops.update(block.dropped or {})
        imu = block.imu
        if imu is None or not len(imu):
            return []
        imu = imu if self.options.nominal is None else self.options.nominal.apply(imu)
        self._store.add(self._check.push(imu))
        self._n_unsearched += len(imu)
        # Search for rest after enough samples, and so that searches take a small share of the time.
        period = self._check.statistics().period
        if self._n_unsearched * period < SEARCH_STEP or not self._pacer.due(self._clock()):
            return []
        start = self._clock()
        self._n_unsearched = 0
        self._search(self._store)
        if self._store.forget(self.scan.rests, MAX_LIVE_POSES):
            # The ranges at rest are indices of samples, which have changed.
            self._search(self._store)
        self._pacer.note(start, self._clock())
        return self._newly_ended()

    def _search(self, store: HandStore) -> None:
        """Search the samples of a store for rest, and store the result in `scan`."""
        imu = store.samples()
        if imu is not None and len(imu) > 2:
            self.scan = look_for_poses(imu, self.options.windows)

    def _newly_ended(self) -> list[ImuSamples]:
        """Return the mean reading of each rest that has ended since the last call."""
        imu = self._store.samples()
        scan = self.scan
        if imu is None or scan.poses is None:
            return []

        # Unless the last rest still lasts, it has ended too.
        ended = scan.rests[:-1] if scan.resting else scan.rests
        reported_ns = self._reported_ns
        means = []
        for k, rest in enumerate(ended):
            if reported_ns is not None and imu.stamp_ns[rest.start] <= reported_ns:
                continue
            middle = (rest.start + rest.stop) // 2
            means.append(
                ImuSamples(
                    self._store.true_stamps(imu.stamp_ns[[middle]]),
                    scan.poses.force[[k]],
                    scan.poses.rate[[k]],
                    imu.frame_id,
                )
            )
            self._reported_ns = int(imu.stamp_ns[rest.stop - 1])
        return means

    def solve(self, pending: bool = False, provenance: dict | None = None) -> HandResult:
        """
        Solve the collected samples and return the HandResult, also stored in `result`.

        Parameters
        ----------
        pending : bool
            Include the last sample, which may prove to be a stray; the current rest is included in
            any case.
        provenance : dict, optional
            For the document.

        Raises
        ------
        NotObservableError
            With fewer than four different attitudes.
        InputError
            When the units are plainly wrong, or the stream holds the readings of two IMUs.

        """
        store = self._store
        if pending:
            store = store.copy()
            store.add(copy.deepcopy(self._check).finish())
        imu = store.samples()
        if imu is None or len(imu) < 3:
            raise NotObservableError(
                f'calibration by hand needs {MIN_ATTITUDES} different attitudes at rest, no sample'
                ' was received; check the topic',
                code='no_samples',
            )
        self._check.sources.require_one()
        self._search(store)
        frozen_sensors = _frozen(imu)
        for sensor in frozen_sensors:
            imu = without_sensor(imu, sensor)
        delay = delay_of(imu)
        recording = SampleRecording(
            imu=imu,
            temperature_c=None,
            counts=self.counts,
            findings=tuple(late_gyroscope(delay)),
            delay=delay,
            unusable=frozen_sensors,
        )
        self.result = calibrate_poses(recording, self.options, provenance, stills=self.scan.rests)
        return self.result

    def saved(self, pending: bool = False) -> bytes:
        """Return the samples as bytes, for `saved` of another run."""
        store = self._store.copy()
        store.add(copy.deepcopy(self._check).finish())
        return store.to_bytes()

    def residuals(self, poses: Sequence[ImuSamples]) -> ImuSamples | None:
        """
        Return measured minus predicted mean readings of poses from `push`.

        The direction of gravity in a pose is estimated, so only the length of the specific force
        can differ from its prediction; the rate is compared with zero. None before the first
        solution.
        """
        if self.result is None or not poses:
            return None
        mean = ImuSamples.concatenate(poses)
        hand = self.result.applied
        time = 1e-9 * (mean.stamp_ns - self.result.gathered.first_stamp_ns)
        true_force, true_rate = hand.compensate(mean.force_s, mean.rate_s, time)
        gravity_s = true_force * (hand.gravity / np.linalg.norm(true_force, axis=1))[:, None]
        # The matrices convert errors of true values to errors of readings.
        _, force_matrix = hand.accelerometer
        force_residual = (true_force - gravity_s) @ force_matrix.T
        rate_residual = true_rate @ hand.gyroscope.matrix.T
        if 'accelerometer' in self.result.calibration.absent:
            force_residual = np.full_like(true_force, np.nan)
        if 'gyroscope' in self.result.calibration.absent:
            rate_residual = np.full_like(true_rate, np.nan)
        return ImuSamples(mean.stamp_ns, force_residual, rate_residual, mean.frame_id)

    def waiting(self) -> list[GroupState]:
        """Return the state of every effect of the present sensors, with the first needs."""
        waiting = []
        for group in waiting_groups(self.model):
            if group.sensor not in self.scan.absent:
                waiting.append(replace(group, needs=_FIRST_NEEDS[group.sensor]))
        return waiting

    def coverage(self) -> Coverage:
        """Return the Coverage: useful attitudes, and the next one."""
        inputs = (self.scan, self.result, self.options.gravity)
        if self._last_coverage is not None:
            last_inputs, coverage = self._last_coverage
            if all(new is old for new, old in zip(inputs, last_inputs, strict=True)):
                return coverage
        coverage = hand_coverage(
            self.scan, self.result, hand_options(self.options), frame_id=self.frame_id
        )
        self._last_coverage = (inputs, coverage)
        return coverage

    def status(self, hints: dict[str, str] | None = None) -> LiveState:
        """
        Return the LiveState: progress, and the pose or turn with the largest gain.

        `hints` as for `errors.with_hint`.
        """
        status = hand_status(
            self.scan,
            self.result.calibration if self.result else None,
            step=self.coverage().next.text,
            hints=hints,
        )
        return replace(
            status,
            values={
                **status.values,
                'samples kept': len(self._store),
                'samples forgotten': self._store.forgotten,
            },
        )


def _frozen(imu: ImuSamples) -> dict[str, str]:
    """
    Return sensor -> text why it cannot be used, for sensors whose readings never change.

    Raises
    ------
    InputError
        When no other sensor can be used.

    """
    frozen = {}
    for sensor, values in (('accelerometer', imu.force_s), ('gyroscope', imu.rate_s)):
        if sensor not in imu.absent and not np.ptp(values, axis=0).any():
            frozen[sensor] = frozen_text(sensor, len(imu), is_zero=not values.any())
    if frozen and len({*frozen, *imu.absent}) == len(SENSORS):
        raise InputError(next(iter(frozen.values())), code='frozen')
    return frozen


def _check_model(model: SensorModel) -> None:
    """
    Refuse effects that need a table, and effects of temperature.

    A live session stores no temperatures with the poses.
    """
    thermal = [effect.name for effect in model.effects if 'temperature' in effect.needs]
    if thermal:
        raise InputError(
            f'{", ".join(thermal)} must be estimated by hand from a recording, live no temperatures'
            " are kept; record a bag and run 'imu_calibration calibrate BAG', or omit it",
            code='offline_only',
        )
    HandModel(model, STANDARD_GRAVITY)
