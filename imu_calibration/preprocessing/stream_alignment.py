"""
Alignment of streams, chunk by chunk of a fixed grid in time.

Position and phase of the joints at the IMU's stamps.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from imu_calibration.core.samples import ImuSamples, JointSamples, TemperatureSamples, runs_of
from imu_calibration.kinematics.joint_motion import JointMotion
from imu_calibration.kinematics.signal_history import (
    BandVariance,
    TemperatureSlope,
    ThermalBranch,
)
from imu_calibration.preprocessing import window_cutter
from imu_calibration.preprocessing.rest_detection import (
    QUIETNESS_REACH,
    QuietFloor,
    quiet_beside_joints,
)
from imu_calibration.preprocessing.window import PhasedSamples, WindowSettings
from imu_calibration.preprocessing.window_cutter import LEAST_READINGS, LOST, STILL, JointRun


class SampleBuffer:
    """Samples of one stream in the order of their stamps; joins its blocks only when read."""

    def __init__(self) -> None:
        self.newest_ns: int | None = None
        self._blocks = []

    def __len__(self) -> int:
        return sum(len(block) for block in self._blocks)

    def add(self, samples: ImuSamples | JointSamples | TemperatureSamples) -> None:
        """Append samples; all stamps must exceed the buffered ones."""
        if len(samples):
            self.newest_ns = int(samples.stamp_ns[-1])
            self._blocks.append(samples)

    def between(self, first_ns: int, stop_ns: int) -> Any:
        """Return the samples with stamps in [first, stop), or None when the buffer is empty."""
        samples = self._joined()
        if samples is None:
            return None
        return samples.select(slice(*np.searchsorted(samples.stamp_ns, [first_ns, stop_ns])))

    def first_from(self, stamp_ns: int) -> int | None:
        """Return the first stamp that is not before `stamp_ns`, or None."""
        samples = self._joined()
        if samples is None:
            return None
        place = np.searchsorted(samples.stamp_ns, stamp_ns)
        return int(samples.stamp_ns[place]) if place < len(samples) else None

    def forget_before(self, stamp_ns: int, keep_one: bool = False) -> None:
        """Drop samples before `stamp_ns`; with `keep_one` not the last one of them."""
        while len(self._blocks) > 1 and self._blocks[1].stamp_ns[0] < stamp_ns:
            del self._blocks[0]
        if self._blocks and self._blocks[0].stamp_ns[0] < stamp_ns:
            block = self._blocks[0]
            place = max(0, int(np.searchsorted(block.stamp_ns, stamp_ns)) - keep_one)
            if place:
                kept = block.select(slice(place, None))
                # A slice would keep the complete block in memory.
                self._blocks[:1] = [type(kept).concatenate([kept])] if len(kept) else []

    def _joined(self):
        if len(self._blocks) > 1:
            self._blocks = [type(self._blocks[0]).concatenate(self._blocks)]
        return self._blocks[0] if self._blocks else None


JOINT_WAIT = 60.0
"""
The IMU or the joints may be ahead of each other by this much before missing samples are skipped, s.
"""
TEMPERATURE_WAIT = 5.0
"""Largest delay of the temperature relative to the IMU, s."""
_LEAST_MARGIN = max(window_cutter.PHASE_REACH, QUIETNESS_REACH) + 0.4
NEVER = 1 << 62


class MotionChunks:
    """
    One epoch of the clock: converts samples to `PhasedSamples`, in order.

    Chunk k holds the IMU samples of `chunk` seconds from ``start + k * chunk`` on; `start` is the
    first IMU sample. The result depends on samples within the chunk and a margin only, and a chunk
    is processed when all streams have passed its margin (or are given up), so the division of the
    streams into blocks has no effect. The waiting times bound the memory.
    """

    def __init__(
        self,
        settings: WindowSettings,
        noise_rad: float | None,
        floors: tuple[QuietFloor, QuietFloor],
    ):
        self.counts = Counter()
        self.time_origin = 0.0
        self._settings = settings
        self._noise_rad = noise_rad
        self._floors = floors
        self._imu = SampleBuffer()
        self._joints = SampleBuffer()
        self._temperature = SampleBuffer()
        self._branch = ThermalBranch()
        self._vibration = BandVariance()
        self._slope = TemperatureSlope()
        self.margin = max(settings.overlap, _LEAST_MARGIN)
        self._chunk_ns, self._margin_ns = _ns(settings.chunk), _ns(self.margin)
        self._start_ns: int | None = None
        self._first_joint_ns: int | None = None
        self._chunk = 0
        self._previous_ns: int | None = None
        self._after_loss = False

    @property
    def short_rest(self) -> float:
        """Length of the rests that have a curve of the joints throughout, s."""
        return min(self._settings.settling + self._settings.static_minimum, self.margin)

    def change(self, settings: WindowSettings) -> None:
        """
        Use other settings from the next chunk on.

        The length of the chunks and their margin are unchanged.
        """
        self._settings = settings

    @property
    def n_buffered(self) -> int:
        """Samples held, of all streams."""
        return sum(len(buffer) for buffer in (self._imu, self._joints, self._temperature))

    @property
    def end_time(self) -> float:
        """Session time at the newest IMU sample, s."""
        if self._imu.newest_ns is None or self._start_ns is None:
            return self.time_origin
        return self.time_origin + (self._imu.newest_ns - self._start_ns) / 1e9

    def add(
        self,
        imu: ImuSamples | None = None,
        joints: JointSamples | None = None,
        temperature: TemperatureSamples | None = None,
    ) -> None:
        """Add cleaned samples, each stream in the order of its stamps."""
        if imu is not None and len(imu):
            if self._start_ns is None:
                self._start_ns = int(imu.stamp_ns[0])
            self._imu.add(self._not_late(imu, 'late IMU sample'))
        if joints is not None and len(joints):
            if self._first_joint_ns is None:
                self._first_joint_ns = int(joints.stamp_ns[0])
            self._joints.add(self._not_late(joints, None))
        if temperature is not None and len(temperature):
            self._temperature.add(
                replace(
                    temperature,
                    branch=self._branch.of(temperature.temperature_c),
                    rate=self._slope.of(temperature.stamp_ns, temperature.temperature_c),
                )
            )

    def take(self, final: bool = False) -> Iterator[PhasedSamples]:
        """
        Yield the chunks that can be processed (all with `final`) as `PhasedSamples`.

        Without samples that have no joints.
        """
        if self._start_ns is not None:
            passed = np.inf if final else self._passed_ns()
            while (
                self._next_start_ns() + self._chunk_ns + self._margin_ns <= passed
                and self._advance(passed, final)
            ):
                chunk = self._work(self._next_start_ns(), final)
                self._chunk += 1
                if chunk is not None:
                    yield chunk
        self._forget()

    def joints_left(self) -> JointSamples:
        """Return the joint samples that are still held, or None."""
        return self._joints.between(-NEVER, NEVER)

    def _next_start_ns(self):
        return self._start_ns + self._chunk * self._chunk_ns

    def _passed_ns(self):
        """Return the stamp that all streams have passed or will never pass."""
        imu, joints, temperature = (
            -NEVER if b.newest_ns is None else b.newest_ns
            for b in (self._imu, self._joints, self._temperature)
        )
        given_up = _ns(JOINT_WAIT)
        imu, joints = max(imu, joints - given_up), max(joints, imu - given_up)
        return min(imu, joints, max(temperature, imu - _ns(TEMPERATURE_WAIT)))

    def _advance(self, passed, final):
        """Advance to the next chunk with IMU samples; False when there is none yet."""
        oldest = self._imu.first_from(self._next_start_ns())
        if oldest is None:
            if not final:
                self._chunk = max(
                    self._chunk, int((passed - self._margin_ns - self._start_ns) // self._chunk_ns)
                )
            return False
        # Set by the first samples, which are necessary for `oldest`.
        assert self._start_ns is not None
        self._chunk = (oldest - self._start_ns) // self._chunk_ns
        return self._next_start_ns() + self._chunk_ns + self._margin_ns <= passed

    def _not_late(self, samples, reason):
        """Return `samples` without the ones in chunks already processed."""
        if self._start_ns is None or self._chunk == 0:
            return samples
        late = int(
            np.searchsorted(
                samples.stamp_ns, self._next_start_ns() - (0 if reason else self._margin_ns)
            )
        )
        if reason:
            self._count(reason, late)
        return samples.select(slice(late, None)) if late else samples

    def _forget(self):
        if self._start_ns is not None:
            oldest = self._next_start_ns() - self._margin_ns
        elif self._joints.newest_ns is not None:
            oldest = self._joints.newest_ns - _ns(JOINT_WAIT)
        else:
            oldest = (self._temperature.newest_ns or 0) - _ns(JOINT_WAIT)
        for buffer, keep_one in (
            (self._imu, False),
            (self._joints, False),
            (self._temperature, True),
        ):
            buffer.forget_before(oldest, keep_one)

    def _count(self, reason, number):
        self.counts += Counter({reason: int(number)})  # without zeros

    def _work(self, start_ns, final):
        """Return the chunk from `start_ns` on, or None when no sample in it can be used."""
        stop_ns = start_ns + self._chunk_ns
        imu = self._imu.between(start_ns - self._margin_ns, stop_ns + self._margin_ns)
        core = slice(*np.searchsorted(imu.stamp_ns, [start_ns, stop_ns]))
        time = (imu.stamp_ns - self._start_ns) / 1e9
        period = float(np.median(np.diff(time))) if len(time) > 1 else self._settings.gap / 5
        runs, limit = self._joint_runs(
            start_ns - self._margin_ns, stop_ns + self._margin_ns, period
        )
        phase, level, joint_step = self._phases(time, runs, final)
        quiet = quiet_beside_joints(
            imu.force_s,
            imu.rate_s,
            period,
            ratio=self._settings.quiet_ratio,
            longest=self._settings.static_minimum,
            floors=self._floors,
            resting=phase == STILL,
        )
        after_gap = self._after_gaps(imu.stamp_ns[core], limit)
        # Position, velocity, acceleration and jerk of the joints.
        motion = np.zeros((4,) + level[core].shape)
        motion[0] = level[core]
        self._draw_curves(motion, time[core], phase[core], runs)
        temperature, branch, rate = self._warmth(imu.stamp_ns[core], stop_ns + self._margin_ns)
        vibration = self._vibration.of(period, imu.force_s[core])
        corrected = None if imu.corrected is None else imu.corrected[core]
        return self._without_lost(
            PhasedSamples(
                imu.stamp_ns[core],
                imu.force_s[core],
                imu.rate_s[core],
                JointMotion(
                    time[core] + self.time_origin,
                    motion[0],
                    motion[1],
                    motion[2],
                    motion[3],
                    branch,
                    vibration,
                    rate,
                ),
                temperature,
                phase[core],
                quiet[core],
                after_gap,
                np.zeros(len(after_gap), bool),
                joint_step[core],
                corrected,
                imu.absent,
            ),
            self._at_edge(imu.stamp_ns[core], limit, final),
        )

    def _joint_runs(self, first_ns, last_ns, period):
        """
        Return joint readings between two stamps as stretches without gaps.

        The longest step that is no gap, in s, is returned as well.
        """
        joints = self._joints.between(first_ns, last_ns)
        limit = max(self._settings.gap, 5 * period)
        if joints is None or not len(joints):
            return [], limit
        time = (joints.stamp_ns - self._start_ns) / 1e9
        step = np.diff(time)
        joint_limit = max(limit, 3 * float(np.median(step))) if len(step) else limit
        runs = []
        for a, b in runs_of(np.ones(len(time)), step > joint_limit):
            if b - a >= LEAST_READINGS:
                runs.append(
                    JointRun(
                        time[a:b],
                        joints.position[a:b],
                        joints.velocity[a:b],
                        settings=self._settings,
                        noise_rad=self._noise_rad,
                    )
                )
        return runs, limit

    def _phases(self, time, runs, final):
        """
        Return the phase of each IMU sample, and the level and steps of the joints there.

        The level is that of the joints and the steps are of their encoders.
        """
        phase = np.full(len(time), LOST, np.int8)
        level = np.zeros((len(time), runs[0].position.shape[1] if runs else 1))
        steps = np.zeros(level.shape)
        # Set by the first samples.
        assert self._start_ns is not None
        for k, run in enumerate(runs):
            first = (
                self._first_joint_ns is not None
                and run.time[0] <= (self._first_joint_ns - self._start_ns) / 1e9
            )
            inside = run.covered(time, before=first, after=final and k == len(runs) - 1)
            phase[inside], level[inside] = run.at(time[inside])
            steps[inside] = run.step
        return phase, level, steps

    def _draw_curves(self, motion, time, phase, runs):
        """Set the joints' motion on the samples near moving joints."""
        for run in runs:
            need = np.flatnonzero((phase != LOST) & run.near_motion(time, self.short_rest))
            if not len(need):
                continue
            parts = np.split(
                need, np.flatnonzero(np.diff(time[need]) > 2 * self._settings.overlap) + 1
            )
            for part in parts:
                stretch = slice(part[0], part[-1] + 1)
                curve = run.curve(time[stretch], self._settings.overlap, self._noise_rad)
                for target, values in zip(
                    motion,
                    (curve.position, curve.rate, curve.acceleration, curve.jerk),
                    strict=True,
                ):
                    target[stretch] = values

    def _after_gaps(self, stamp_ns, limit):
        before = stamp_ns[0] - (1 << 40) if self._previous_ns is None else self._previous_ns
        self._previous_ns = int(stamp_ns[-1])
        return np.diff(np.concatenate([[before], stamp_ns])) > _ns(limit)

    def _warmth(self, stamp_ns, last_ns):
        """Return (temperatures, thermal branches, slopes of the temperature) at the stamps."""
        readings = self._temperature.between(-NEVER, last_ns)
        if readings is None or not len(readings):
            return np.full((3, len(stamp_ns)), np.nan)
        at = (stamp_ns - self._start_ns) / 1e9
        known = (readings.stamp_ns - self._start_ns) / 1e9
        series = (readings.temperature_c, readings.branch, readings.rate)
        return [np.interp(at, known, values) for values in series]

    def _at_edge(self, stamp_ns, limit, final):
        """
        Return a mask of the samples close before the first joint state or after the last one.

        Where no joint state is missing.
        """
        if self._first_joint_ns is None:
            return np.zeros(len(stamp_ns), bool)
        edge = (stamp_ns < self._first_joint_ns) & (stamp_ns >= self._first_joint_ns - _ns(limit))
        if final and self._joints.newest_ns is not None:
            edge |= (stamp_ns > self._joints.newest_ns) & (
                stamp_ns <= self._joints.newest_ns + _ns(limit)
            )
        return edge

    def _without_lost(self, samples, edge):
        lost = samples.phase == LOST
        before = np.concatenate([[self._after_loss], lost[:-1]])
        self._after_loss = bool(lost[-1])
        samples.after_gap[before] = True
        samples.after_loss[before] = True
        if not lost.any():
            return samples
        self._count('no joint state', np.count_nonzero(lost & ~edge))
        self._count('edge of joints', np.count_nonzero(lost & edge))
        return None if lost.all() else samples.select(~lost)


def _ns(seconds):
    return int(round(seconds * 1e9))
