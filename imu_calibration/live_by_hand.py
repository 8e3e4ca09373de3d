"""Calibration by hand while the IMU is being turned: poses are counted, the direction that is missing is named, the answer is that of the recording."""

import copy
import time
from dataclasses import dataclass, replace

import numpy as np

from imu_calibration.by_hand import POSES_FULL, POSES_LEAST, ByHandSettings
from imu_calibration.by_hand_document import HandRecording, calibrate_samples_by_hand
from imu_calibration.by_hand_poses import average_poses, collect_turns, distinct_attitudes
from imu_calibration.errors import NotObservableError
from imu_calibration.hand_store import HandStore
from imu_calibration.live_calibration import GroupState, SolvePacer, group_status, waiting_groups
from imu_calibration.samples import ImuSamples
from imu_calibration.sensor_model import SensorModel, parse_effects
from imu_calibration.settings import setting
from imu_calibration.still_search import find_still
from imu_calibration.stream_check import StreamCheck
from imu_calibration.verdict import SCALES
from imu_calibration.workflow import SENSORS, CalibrationOptions, result_by_hand

FACES = {f'{sign}{axis}': direction for axis, unit in zip('xyz', np.eye(3)) for sign, direction in (('+', unit), ('-', -unit))}
"""The six directions that can be turned up."""
SEEN = np.pi / 4
"""A face counts as seen when an attitude lies within this angle of it, rad."""
SEARCH_STEP = 0.5
"""Rest is looked for after so many seconds of new samples, at the earliest."""
_FIRST_NEEDS = {'accelerometer': 'hold it still in many attitudes', 'gyroscope': 'turn it from one attitude to the next, within half a minute'}
MOST_POSES = 200
"""The time of the joint estimate grows with the third power of their number; the oldest are forgotten."""


@dataclass(frozen=True)
class LiveByHandSettings:
    """What a calibration by hand keeps, and its reference."""

    gravity: float = setting(0.0, 'm/s^2', 'local gravity, used without a table; 0: the standard gravity, which may be off by 0.02', (0.0, 30.0),
                             'all three accelerometer scales are wrong together')
    hand_samples: int = setting(800_000, '1', 'Imu samples kept without a table, about 60 bytes each (800000: over an hour at 200 Hz); beyond them '
                                'the inside of the longest rest is forgotten, then the oldest', (2000, 100_000_000),
                                'too small: poses are forgotten, diagnostics say so')


@dataclass(frozen=True, eq=False)
class Findings:
    """What the search for rest found in the samples so far."""

    rests: list
    """Ranges at rest (slice)."""
    poses: object
    """`Poses`, or None without any rest."""
    attitudes: int
    """Different attitudes."""
    turns: int
    """Turns between consecutive poses that can be used."""
    dropped: dict
    """Reason -> turns that cannot be used."""
    resting: float
    """How long the IMU has been at rest now, s; 0 while it moves."""


NOTHING = Findings([], None, 0, 0, {}, 0.0)


@dataclass(frozen=True)
class HandStatus:
    """How far a calibration by hand has come, for people."""

    word: str
    """'waiting' before a solution is possible, 'weak' while something is missing, or 'determined'."""
    message: str
    """One line: what there is, and what to do next."""
    values: dict
    """Figures by name."""


class LiveByHand:
    """
    One session without a table as it happens: `push` what arrives, `solve` when it is due.

    The samples are cleaned, searched and solved by the functions that read recordings, and they are all kept while they fit: the answer
    is that of `workflow.calibrate_without_table` on the same samples. When they no longer fit (`hand_samples`) it is the answer to the
    samples that are left. A clock that is set anew, which a recording is refused for, is taken as a pause.

    Parameters
    ----------
    options : CalibrationOptions
        What to estimate.
    settings : LiveSettings
        Its `solve_share` bounds the search for rest too.
    by_hand : LiveByHandSettings
    saved : bytes, optional
        What `saved` of an earlier run returned.
    clock : callable
        Seconds of a steady clock.

    """

    def __init__(self, options, settings, by_hand=LiveByHandSettings(), saved=None, clock=time.monotonic):
        self.options, self.settings, self._clock = options, settings, clock
        self._names = {sensor: None if text is None else parse_effects(sensor, text)
                       for sensor, text in zip(SENSORS, (options.accelerometer_model, options.gyroscope_model))}
        self._gravity = by_hand.gravity or None
        self._check, self._store, self._drops = StreamCheck(), HandStore(by_hand.hand_samples), {}
        if saved is not None:
            self._store.load(saved)
        self._pacer, self._unsearched, self._reported_ns = SolvePacer(settings.solve_share), 0, None
        self.found, self.result = NOTHING, None
        self._search(self._store)

    @property
    def model(self):
        """The model, as far as it is known before a solution."""
        return SensorModel(*(names or ('bias', 'matrix') for names in self._names.values()))

    @property
    def n_windows(self):
        """Poses at the last search."""
        return len(self.found.rests)

    @property
    def counts(self):
        """Samples that could not be used, by reason."""
        counts = dict(self._drops)
        for reason, count in self._check.counts.items():
            counts[f'imu {reason}'] = counts.get(f'imu {reason}', 0) + count
        return {reason: count for reason, count in counts.items() if count}

    def push(self, block):
        """Take what arrived and return the poses that are over and were not returned before, as mean ImuSamples, one each, in a list."""
        for reason, count in (block.dropped or {}).items():
            self._drops[reason] = self._drops.get(reason, 0) + count
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
        if self._store.forget(self.found.rests, MOST_POSES):
            self._search(self._store)
        self._pacer.note(start, self._clock())
        return self._newly_over()

    def _search(self, store):
        imu = store.samples()
        if imu is not None and len(imu) > 2:
            self.found = look_for_poses(imu, self.options.windows)

    def _newly_over(self):
        imu, found = self._store.samples(), self.found
        over = found.rests if not found.resting else found.rests[:-1]
        new = [k for k, rest in enumerate(over) if self._reported_ns is None or imu.stamp_ns[rest.start] > self._reported_ns]
        if new:
            self._reported_ns = int(imu.stamp_ns[over[new[-1]].stop - 1])
        middle = [(found.rests[k].start + found.rests[k].stop) // 2 for k in new]
        return [ImuSamples(self._store.true_stamps(imu.stamp_ns[[m]]), found.poses.force[[k]], found.poses.rate[[k]], imu.frame_id)
                for k, m in zip(new, middle)]

    def solve(self, pending=False, provenance=None):
        """
        Solve what was gathered and return the CalibrationResult, which stays in `result`.

        Parameters
        ----------
        pending : bool
            Count the last sample in, which may yet turn out to be a stray; the rest that goes on counts in any case.
        provenance : dict, optional
            For the document.

        Raises
        ------
        NotObservableError
            With fewer than four different attitudes.
        InputError
            When the units are plainly wrong.

        """
        store = self._store
        if pending:
            store = store.copy()
            store.add(copy.deepcopy(self._check).finish())
        imu = store.samples()
        if imu is None or len(imu) < 3:
            raise NotObservableError(f'calibration by hand needs {POSES_LEAST} different attitudes held still, no sample came yet; check the topic')
        self._search(store)
        recording = HandRecording(imu, None, self.counts)
        solved = calibrate_samples_by_hand(recording, self._gravity, self.options.tolerances, provenance, *self._names.values(),
                                           stills=self.found.rests)
        self.result = result_by_hand(*solved, self.options)
        return self.result

    def needs_linearising(self):
        """Return False: the solution is iterated to its end."""
        return False

    def saved(self, pending=False):
        """Return the samples as bytes, for `saved` of another run."""
        return self._store.to_bytes()

    def residuals(self, poses):
        """
        Return measured minus predicted of poses from `push`, as ImuSamples, or None before the first solution.

        The direction of gravity in a pose is estimated, so that of the specific force only the length can differ from what is
        predicted; the rate is compared with zero.
        """
        if self.result is None or not poses:
            return None
        mean, hand = ImuSamples.concatenate(poses), self.result.solution
        true, _ = hand.compensate(mean.force_s, mean.rate_s)
        bias, matrix = hand.accelerometer
        gravity_s = true * (hand.gravity / np.linalg.norm(true, axis=1))[:, None]
        resting_bias, _, sensitivity = hand.gyroscope
        return ImuSamples(mean.stamp_ns, (true - gravity_s) @ matrix.T, mean.rate_s - resting_bias - gravity_s @ sensitivity.T, mean.frame_id)

    def groups(self):
        """Return the GroupState of every effect."""
        if self.result is None:
            return [replace(group, needs=_FIRST_NEEDS[group.sensor]) for group in waiting_groups(self.model)]
        return _group_states(self.result)

    def question(self):
        """Return None: what the model gets wrong is asked of recordings."""

    def status(self):
        """Return the HandStatus: what there is, and the pose or turn that helps most."""
        word, needs = self._needs()
        found = self.found
        values = {'poses': len(found.rests), 'attitudes': found.attitudes, 'turns': found.turns,
                  **{f'turns left out: {reason}': count for reason, count in found.dropped.items()},
                  'directions of gravity not seen': ' '.join(self.unseen()), 'at rest for [s]': f'{found.resting:.1f}',
                  'samples kept': len(self._store), 'samples forgotten': self._store.forgotten, 'next': '; '.join(needs)}
        parts = [f'{_plural(len(found.rests), "pose")} in {_plural(found.attitudes, "attitude")}, {_plural(found.turns, "turn")}']
        if found.dropped:
            parts.append('turns left out: ' + ', '.join(f'{count} {reason}' for reason, count in sorted(found.dropped.items())))
        if found.resting:
            parts.append(f'at rest for {found.resting:.1f} s: this pose counts, move on')
        parts += [f'next: {need}' for need in needs] if needs else ['everything is determined: save it']
        return HandStatus(word, '; '.join(parts), values)

    def unseen(self):
        """Return the faces ('+x', ...) that have not been up, the one furthest from all attitudes first."""
        if self.found.poses is None:
            return list(FACES)
        up = self.found.poses.force / np.linalg.norm(self.found.poses.force, axis=1, keepdims=True)
        nearest = {name: float(np.arccos(np.clip(up @ face, -1, 1)).min()) for name, face in FACES.items()}
        return sorted((name for name, angle in nearest.items() if angle > SEEN), key=lambda name: -nearest[name])

    def _needs(self):
        unseen = self.unseen()
        if self.found.attitudes < POSES_LEAST or self.result is None:
            still = f'hold it still with {unseen[0]} up' if unseen else 'hold it still in an attitude between two faces'
            more = f' (not seen yet: {", ".join(unseen)})' if len(unseen) > 1 else ''
            return 'waiting', [f'{still}{more}; {POSES_LEAST} attitudes at least, {POSES_FULL} for everything']
        calibration = self.result.calibration
        lacking = [name for name, status in zip(calibration.param_names, calibration.status) if status != 'determined']
        if not lacking:
            return 'determined', []
        if self._gravity is None and set(lacking) <= set(SCALES):
            return 'weak', ["give the local gravity (parameter 'gravity'), which scales the accelerometer as a whole"]
        return 'weak', list(dict.fromkeys(item['needs'] for item in calibration.undetermined))


def look_for_poses(imu, windows):
    """Return the Findings in ImuSamples with rising stamps."""
    rests = [rest for rest in find_still(imu, windows) if rest.stop - rest.start >= 2]
    if not rests:
        return NOTHING
    settings, seconds = ByHandSettings(), 1e-9 * (imu.stamp_ns - imu.stamp_ns[0])
    poses, noise = average_poses(imu, [(rest.start, rest.stop) for rest in rests])
    turns, dropped = collect_turns(seconds, imu, poses, noise, settings)
    goes_on = seconds[-1] - seconds[rests[-1].stop - 1] <= 0.1
    resting = float(seconds[-1] - seconds[rests[-1].start]) if goes_on else 0.0
    return Findings(rests, poses, distinct_attitudes(poses.force, settings.pose_apart), len(turns), dropped, resting)


def _group_states(result):
    """Return the GroupState of every effect of a calibration by hand."""
    calibration, states = result.calibration, []
    names, sd = calibration.param_names, calibration.sd
    for effect in calibration.model.effects:
        part = calibration.model.slices[effect.sensor, effect.name]
        worst = part.start + int(np.argmax(sd[part] / result.tolerances[part]))
        state = group_status(calibration.status[part])
        own = set(names[part]) if state != 'determined' else set()
        needs = next((item['needs'] for item in calibration.undetermined if own & set(item['parameters'])), '')
        states.append(GroupState(effect.sensor, effect.name, state, names[worst], float(sd[worst]), float(result.tolerances[worst]),
                                 effect.unit_of(worst - part.start), needs))
    return states


def _plural(count, noun):
    return f'{count} {noun}' + ('' if count == 1 else 's')
