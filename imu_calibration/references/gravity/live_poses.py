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
from imu_calibration.effects.sensor_model import BASE, SensorModel
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

    rests: list
    """Ranges at rest (slice)."""
    poses: Poses | None
    """Their means; None without any rest."""
    attitudes: int
    """Number of different attitudes."""
    turns: int
    """Number of usable turns between consecutive poses."""
    dropped: dict
    """Reason -> number of unusable turns."""
    resting: float
    """Duration of the current rest, s; 0 in motion."""
    absent: tuple[str, ...] = ()
    """Sensors without readings."""


EMPTY_SCAN = PoseScan([], None, 0, 0, {}, 0.0)


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
    goes_on = seconds[-1] - seconds[rests[-1].stop - 1] <= 0.1
    resting = float(seconds[-1] - seconds[rests[-1].start]) if goes_on else 0.0
    attitudes = distinct_attitudes(poses.force)
    return PoseScan(rests, poses, attitudes, len(turns), dropped, resting, imu.absent)


def hand_status(
    found: PoseScan,
    calibration: Calibration | None,
    *,
    step: str,
    hints: dict[str, str] | None = None,
) -> LiveState:
    """
    Return the LiveState.

    Parameters
    ----------
    found : PoseScan
    calibration : Calibration or None
        The last solution.
    step : str
        Next step in the planner's text (`advice`), '' when no pose has a gain.
    hints : dict, optional
        As for `errors.with_hint`.

    """
    not_seen = unseen(found)
    word, needs = _needs(found, not_seen, calibration, step=step, hints=hints or {})
    values = {
        'poses': len(found.rests),
        'attitudes': found.attitudes,
        'turns': found.turns,
        **{f'turns left out: {reason}': count for reason, count in found.dropped.items()},
        'directions of gravity not seen': ' '.join(not_seen),
        'at rest for [s]': f'{found.resting:.1f}',
        'next': '; '.join(needs),
    }
    parts = [
        f'{_plural(len(found.rests), "pose")} in {_plural(found.attitudes, "attitude")},'
        f' {_plural(found.turns, "turn")}'
    ]
    if found.dropped:
        parts.append(
            'turns left out: '
            + ', '.join(f'{count} {reason}' for reason, count in sorted(found.dropped.items()))
        )
    if found.resting:
        parts.append(f'at rest for {found.resting:.1f} s: this pose counts, move on')
    parts += (
        [f'next: {need}' for need in needs]
        if needs
        else ['all parameters are determined: save the calibration']
    )
    return LiveState(word, '; '.join(parts), values)


def unseen(found: PoseScan) -> list[str]:
    """
    Return the faces ('+x', ...) that have not been up, the one furthest from all attitudes first.
    """
    if 'accelerometer' in found.absent:
        return []
    if found.poses is None:
        return list(FACE_DIRECTIONS)
    up = unit_rows(found.poses.force)
    nearest = {
        name: float(np.arccos(np.clip(up @ face, -1, 1)).min())
        for name, face in FACE_DIRECTIONS.items()
    }
    return sorted(
        (name for name, angle in nearest.items() if angle > FACE_REACH),
        key=lambda name: -nearest[name],
    )


def _needs(
    found: PoseScan,
    not_seen: Sequence[str],
    calibration: Calibration | None,
    *,
    step: str,
    hints: dict[str, str],
) -> tuple[Progress, list[str]]:
    if 'accelerometer' in found.absent:
        # Gravity is not measured: one rest determines the bias, and no turn the matrix.
        if calibration is None:
            return Progress.WAITING, ['hold it still']
        if not parameter_count(calibration).lacking:
            return Progress.DETERMINED, []
        return Progress.WEAK, needs_of(calibration)
    if found.attitudes < MIN_ATTITUDES or calibration is None:
        more = f' (faces not seen yet: {", ".join(not_seen)})' if not_seen else ''
        return Progress.WAITING, [
            f'{step}{more}; {MIN_ATTITUDES} attitudes at least, {POSES_FULL} for all parameters'
        ]
    if not parameter_count(calibration).lacking:
        return Progress.DETERMINED, []
    needs = needs_of(calibration)
    without_motion = [
        with_hint(need, REMEDY_KEYS.get(need), hints) for need in needs if need in NO_STEP
    ]
    if len(without_motion) == len(needs) > 0:
        return Progress.WEAK, without_motion
    # The planned step serves the parameters whose need is a pose or a turn.
    return Progress.WEAK, [step, *without_motion] if step else needs


def needs_of(calibration: Calibration) -> list[str]:
    """Return what the undetermined parameters need; the gravity where it alone is missing."""
    if parameter_count(calibration).lacking == (COMMON_SCALE,):
        return [REMEDIES[GRAVITY,]]
    return list(dict.fromkeys(item['needs'] for item in calibration.undetermined))


def _plural(count: int, noun: str) -> str:
    return f'{count} {noun}' + ('' if count == 1 else 's')


def knowledge_of(found: PoseScan, result: HandResult | None, options: HandOptions) -> HandKnowledge:
    """
    Return the HandKnowledge of a session.

    Before the first solution from its poses, then from the solution.
    """
    if result is not None:
        return knowledge_after(result.applied)
    model = HandModel(
        SensorModel(
            options.accelerometer or BASE, options.gyroscope or BASE, catalogue=options.catalogue
        ),
        options.gravity,
    )
    return knowledge_at_first(
        model, tolerances_of(model.model, options.tolerances), poses=found.poses
    )


def hand_coverage(
    found: PoseScan, result: HandResult | None, options: HandOptions, *, frame_id: str = ''
) -> Coverage:
    """
    Return the Coverage of a session by hand.

    The cells, the next pose with the turn to it, and the remaining seconds.
    """
    # Without an accelerometer gravity is not measured, and no attitude has a gain.
    without_gravity = 'accelerometer' in found.absent
    seen = ups_of(None if without_gravity else found.poses)
    up = seen[-1] if len(seen) else None
    no_gain = Coverage(np.zeros(len(DIRECTIONS)), seen, up, Step(''), 0.0, frame_id=frame_id)
    if result is not None:
        if is_done(result):
            return replace(no_gain, done=True)
        # Nor does an attitude determine more where each need is an input or a cause to be found. A
        # sensor that moved at rest is put down in the attitude that the picture shows.
        needs = needs_of(result.calibration)
        if needs and set(needs) <= set(REMEDY_KEYS):
            return replace(no_gain, next=Step(needs[0]))
    if without_gravity:
        return no_gain
    knowledge = knowledge_of(found, result, options)
    steps = foretold(knowledge)
    if not steps:
        return no_gain
    first = steps[0]
    worth = knowledge.best()[1]
    return Coverage(
        worth,
        seen,
        up,
        Step(first.words, first.up, first.axis, first.angle),
        sum(step.seconds for step in steps),
        frame_id=frame_id,
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
        self._asked = hand_options(self.options)
        _check_model(self.model)
        self._check = StreamCheck(one_sensor=True)
        self._store = HandStore(by_hand.hand_samples)
        self._drops = Counter()
        if saved is not None:
            self._store.load(saved)
        self._pacer = SolvePacer(SEARCH_SHARE)
        self._unsearched = 0
        self._reported_ns: int | None = None
        self._shown: tuple[tuple, Coverage] | None = None
        self.found = EMPTY_SCAN
        self.result: HandResult | None = None
        self._search(self._store)

    @property
    def model(self) -> SensorModel:
        """The model, as far as known before a solution."""
        asked = self._asked
        return SensorModel(
            asked.accelerometer or BASE, asked.gyroscope or BASE, catalogue=asked.catalogue
        )

    observations = PoseObservations.unit
    needs_joints = False

    @property
    def frame_id(self) -> str:
        """Frame of the sensor; '' before the first message."""
        imu = self._store.samples()
        return '' if imu is None else imu.frame_id

    def change(self, settings: LiveSettings | WindowSettings | LiveByHandSettings) -> bool:
        """
        Use other settings from now on.

        For the poses in all samples, another gravity, another number of samples. Return whether
        the poses have to be solved again.
        """
        if isinstance(settings, LiveSettings):
            self.settings = settings
        elif isinstance(settings, WindowSettings):
            self.options = replace(self.options, windows=settings)
            self._search(self._store)
        else:
            self.options, self._store.most = settings.at_place(self.options), settings.hand_samples
            return True
        return False

    @property
    def n_windows(self) -> int:
        """Poses at the last search."""
        return len(self.found.rests)

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
        return dict(
            self._drops
            + Counter({f'imu {reason}': count for reason, count in self._check.counts.items()})
        )

    def push(self, block: SampleBlock) -> list[ImuSamples]:
        """
        Add arriving samples.

        Return the poses completed since the last call, as mean ImuSamples, one each, in a list.
        """
        self._drops.update(block.dropped or {})
        imu = block.imu
        if imu is None or not len(imu):
            return []
        imu = imu if self.options.nominal is None else self.options.nominal.apply(imu)
        self._store.add(self._check.push(imu))
        self._unsearched += len(imu)
        period = self._check.statistics().period
        if self._unsearched * period < SEARCH_STEP or not self._pacer.due(self._clock()):
            return []
        start, self._unsearched = self._clock(), 0
        self._search(self._store)
        if self._store.forget(self.found.rests, MAX_LIVE_POSES):
            self._search(self._store)
        self._pacer.note(start, self._clock())
        return self._newly_over()

    def _search(self, store: HandStore) -> None:
        imu = store.samples()
        if imu is not None and len(imu) > 2:
            self.found = look_for_poses(imu, self.options.windows)

    def _newly_over(self) -> list[ImuSamples]:
        """Return the mean reading of each rest that has ended since the last call."""
        imu = self._store.samples()
        found = self.found
        if imu is None or found.poses is None:
            return []

        # Unless the last rest still lasts, it is over too.
        ended = found.rests[:-1] if found.resting else found.rests
        reported_ns = self._reported_ns
        means = []
        for k, rest in enumerate(ended):
            if reported_ns is not None and imu.stamp_ns[rest.start] <= reported_ns:
                continue
            middle = (rest.start + rest.stop) // 2
            means.append(
                ImuSamples(
                    self._store.true_stamps(imu.stamp_ns[[middle]]),
                    found.poses.force[[k]],
                    found.poses.rate[[k]],
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
        findings = tuple(late_gyroscope(delay))
        recording = SampleRecording(imu, None, self.counts, findings, delay, frozen_sensors)
        self.result = calibrate_poses(recording, self.options, provenance, stills=self.found.rests)
        return self.result

    def saved(self, pending: bool = False) -> bytes:
        """Return the samples as bytes, for `saved` of another run."""
        store = self._store.copy()
        store.add(copy.deepcopy(self._check).finish())
        return store.to_bytes()

    def residuals(self, poses: Sequence[ImuSamples]) -> ImuSamples | None:
        """
        Return measured minus predicted of poses from `push`, as ImuSamples.

        Or None before the first solution.

        The direction of gravity in a pose is estimated, so only the length of the specific force
        can differ from its prediction; the rate is compared with zero.
        """
        if self.result is None or not poses:
            return None
        mean = ImuSamples.concatenate(poses)
        hand = self.result.applied
        time = 1e-9 * (mean.stamp_ns - self.result.gathered.first_stamp_ns)
        true, turning = hand.compensate(mean.force_s, mean.rate_s, time)
        gravity_s = true * (hand.gravity / np.linalg.norm(true, axis=1))[:, None]
        force_residual = (true - gravity_s) @ hand.accelerometer[1].T
        rate_residual = turning @ hand.gyroscope[1].T
        if 'accelerometer' in self.result.calibration.absent:
            force_residual = np.full_like(true, np.nan)
        if 'gyroscope' in self.result.calibration.absent:
            rate_residual = np.full_like(turning, np.nan)
        return ImuSamples(mean.stamp_ns, force_residual, rate_residual, mean.frame_id)

    def waiting(self) -> list[GroupState]:
        """Return the state of every effect of the present sensors, with the first needs."""
        waiting = []
        for group in waiting_groups(self.model):
            if group.sensor not in self.found.absent:
                waiting.append(replace(group, needs=_FIRST_NEEDS[group.sensor]))
        return waiting

    def coverage(self) -> Coverage:
        """Return the Coverage: useful attitudes, and the next one."""
        known = (self.found, self.result, self.options.gravity)
        if self._shown is None or any(
            a is not b for a, b in zip(known, self._shown[0], strict=True)
        ):
            self._shown = (
                known,
                hand_coverage(
                    self.found, self.result, hand_options(self.options), frame_id=self.frame_id
                ),
            )
        return self._shown[1]

    def status(self, hints: dict[str, str] | None = None) -> LiveState:
        """
        Return the LiveState: progress, and the pose or turn with the largest gain.

        `hints` as for `errors.with_hint`.
        """
        status = hand_status(
            self.found,
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
    Return the sensor whose outputs never change -> why it cannot be used.

    Raises
    ------
    InputError
        When no other sensor can be used.

    """
    found = {}
    for sensor, values in (('accelerometer', imu.force_s), ('gyroscope', imu.rate_s)):
        if sensor not in imu.absent and not np.ptp(values, axis=0).any():
            found[sensor] = frozen_text(sensor, len(imu), is_zero=not values.any())
    if len({*found, *imu.absent}) == len(SENSORS) and found:
        raise InputError(next(iter(found.values())), code='frozen')
    return found


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
