"""Serialized Imu message in, corrected serialized message out, with one calibration; knows nothing of ROS."""

import struct
from collections import Counter

import numpy as np

from imu_calibration.compensation.angular_acceleration import WARM_UP, CausalDerivative, StampedDerivative, typical_period
from imu_calibration.compensation.compensate import arms_of, invertible, saturation_level
from imu_calibration.compensation.covariance import Uncertainty
from imu_calibration.compensation.kernel import make_kernel
from imu_calibration.compensation.stream import derivative_for, late_ns
from imu_calibration.effects.base import SENSORS, Role
from msg_adapters.imu import find_imu_layout
from msg_adapters.stamps import MessageError

STAMP_AT = 4
HEAD_AT = 12
"""Bytes before the frame_id's length: encapsulation and stamp."""
NS = 1_000_000_000
MANY = 30
"""Reasons that are counted apart at most, so that memory stays bounded whatever comes."""
NO_SLOPE = (0.0, 0.0, 0.0)
ABSENT = -1.0
"""First element of the covariance of a quantity that the message does not have."""


class LiveCompensation:
    """
    Corrects message after message.

    Everything that repeats from message to message (frame, covariances) is looked at only when its bytes change.

    Parameters
    ----------
    calibration : Calibration
    transfer : compensation.Transfer, optional
        Another point and frame.
    check_frame : bool
        Whether messages must carry the calibration's frame_id.
    with_parameters : bool
        Whether the uncertainty of the calibration enters the covariances.
    correct_stamps : bool
        Whether the stamps are moved back by the calibration's time_offset.

    """

    def __init__(self, calibration, transfer=None, check_frame=True, with_parameters=True, correct_stamps=False):
        self.calibration, self.transfer = calibration, transfer
        self.frame_id = calibration.frame_id if check_frame else ''
        self.with_parameters = with_parameters
        self.counts = Counter()
        self.received, self.corrected, self.fastest_squared = 0, 0, 0.0
        self.needs_temperature = invertible(calibration.model).needs_temperature
        self.dt = None if self.needs_temperature else 0.0
        self.period, self._tracker, self._push, self._steps = None, None, None, []
        self.needs_slope = bool(np.any(arms_of(calibration))) or (transfer is not None and bool(np.any(transfer.arm_t)))
        self._kernel = make_kernel(calibration, transfer)
        self._zero = {s: calibration.of(s, Role.OFFSET).tolist() for s in SENSORS}
        self._levels = tuple(saturation_level(calibration, sensor) for sensor in ('accelerometer', 'gyroscope'))
        self._can_saturate = any(np.isfinite(self._levels))
        self._late_ns = late_ns(calibration, correct_stamps)
        self._head_in, self._size = None, -1
        self._rate_cov_in = self._force_cov_in = self._orientation_cov_in = None
        self.last = ((0.0, 0.0, 9.8), (0.0, 0.0, 0.0), NO_SLOPE, 0.0)
        self._make_uncertainty(None)

    def set_temperature(self, temperature_c):
        """Tell the temperature near the sensor, degrees Celsius."""
        if self.needs_temperature and temperature_c - temperature_c == 0.0:
            self.dt = temperature_c - self.calibration.model.temperature_ref_c

    @property
    def derivative(self):
        """The causal derivative in use, None until the period is known or when it is not needed."""
        return None if self._tracker is None else CausalDerivative(self._tracker.taps, self._tracker.period)

    def refresh(self):
        """Take the covariances of the corrected readings anew at the latest sample; the next message carries them."""
        self._sensitivity = self._uncertainty.at(*self.last)
        self._rate_cov_in = None

    def prepare(self, before):
        """Do beforehand what takes long when this takes over from `before`: period and covariances at its latest sample."""
        if before.period is not None:
            self._settle(before.period)
        self.last = before.last
        self.refresh()

    def follow(self, before):
        """Go on where another compensation stops: same past of the rate, same temperature, same counts."""
        self.counts, self.received, self.corrected = before.counts, before.received, before.corrected
        self.fastest_squared, self._steps = before.fastest_squared, before._steps
        if before.dt is not None and before.needs_temperature and self.dt is None:
            self.set_temperature(before.dt + before.calibration.model.temperature_ref_c)
        if self._tracker is not None and before._tracker is not None:
            self._tracker.seed(before._tracker)

    def __call__(self, data):
        """Return the corrected message as bytes, or None when there is nothing to publish; `counts` says why."""
        self.received += 1
        if len(data) != self._size or data[HEAD_AT:self._head_end] != self._head_in or data[:2] != self._order_in:
            if not self._open(data):
                return None
        if data[self._rate_at + 24:self._rate_at + 96] != self._rate_cov_in or data[self._force_at + 24:] != self._force_cov_in:
            self._take_covariances(data)
        seconds, nanoseconds = self._stamp.unpack_from(data, STAMP_AT)
        wx, wy, wz, fx, fy, fz = self._readings.unpack_from(data, self._rate_at)
        if self._absent:
            wx, wy, wz, fx, fy, fz = self._without_absent(wx, wy, wz, fx, fy, fz)
        total = wx + wy + wz + fx + fy + fz
        dt = self.dt
        if total - total != 0.0 or dt is None:
            return self._refuse('no temperature yet' if dt is None else 'not finite')
        slope = NO_SLOPE
        if self.needs_slope:
            push = self._push
            slope = self._warm_up(seconds * NS + nanoseconds) if push is None else push(seconds * NS + nanoseconds, wx, wy, wz)
        ux, uy, uz, vx, vy, vz = self._kernel(fx, fy, fz, wx, wy, wz, *slope, dt)
        squared = vx * vx + vy * vy + vz * vz
        if squared != squared:
            return self._refuse('beyond what can be undone')
        self.last = ((fx, fy, fz), (wx, wy, wz), slope, dt)
        if squared > self.fastest_squared:
            self.fastest_squared = squared
        rate_cov, force_cov = self._rate_cov_out, self._force_cov_out
        if self._can_saturate:
            rate_cov, force_cov = self._marked(max(abs(fx), abs(fy), abs(fz)), max(abs(wx), abs(wy), abs(wz)), rate_cov, force_cov)
        if self._absent:
            vx, vy, vz, ux, uy, uz = self._with_absent(data, vx, vy, vz, ux, uy, uz)
        self.corrected += 1
        tail = self._tail.pack(vx, vy, vz, rate_cov, ux, uy, uz, force_cov)
        if self._plain:
            return data[:self._rate_at] + tail
        return self._reheaded(data, seconds * NS + nanoseconds) + tail

    def _refuse(self, reason):
        self.counts[reason] += 1

    def _open(self, data):
        """Find the places in a message with a new head; return whether it can be corrected."""
        try:
            layout = find_imu_layout(data)
        except MessageError:
            self._size = -1
            self._refuse('not an Imu message')
            return False
        if self.frame_id and layout.names[0] != self.frame_id:
            self._size = -1
            known = len(self.counts) < MANY or f"frame_id '{layout.names[0]}'" in self.counts
            self._refuse(f"frame_id '{layout.names[0]}'" if known else 'frame_id of many others')
            return False
        order = layout.order
        self._size, self._order_in, self._body = len(data), data[:2], layout.offsets['orientation'][0]
        self._head_end = HEAD_AT + 4 + struct.unpack_from(order + 'I', data, HEAD_AT)[0]   # the padding behind it may hold anything
        self._head_in = data[HEAD_AT:self._head_end]
        self._rate_at, self._force_at = layout.offsets['rate_s'][0], layout.offsets['force_s'][0]
        self._stamp, self._readings = struct.Struct(order + 'iI'), struct.Struct(order + '3d72x3d')
        self._tail = struct.Struct(order + '3d72s3d72s')
        self._nine, self._four = struct.Struct(order + '9d'), struct.Struct(order + '4d')
        frame = layout.names[0] if self.transfer is None else self.transfer.frame_id
        encoded = frame.encode() + b'\0'
        self._head_out = (struct.pack(order + 'I', len(encoded)) + encoded)
        self._head_out += b'\0' * (-(HEAD_AT - 4 + len(self._head_out)) % 8)
        self._plain = self.transfer is None and not self._late_ns
        self._rate_cov_in = self._orientation_cov_in = None
        return True

    def _take_covariances(self, data):
        """Propagate covariances that differ from those of the message before."""
        rate_bytes, force_bytes = data[self._rate_at + 24:self._rate_at + 96], data[self._force_at + 24:self._force_at + 96]
        given = [np.array(self._nine.unpack(raw)).reshape(3, 3) for raw in (force_bytes, rate_bytes)]
        self._no_force, self._no_rate = (cov[0, 0] == ABSENT for cov in given)
        self._absent = bool(self._no_force or self._no_rate)
        known = [np.zeros((3, 3)) if cov[0, 0] == ABSENT else cov if cov.any() else noise
                 for cov, noise in zip(given, self._uncertainty.noise)]
        force_cov, rate_cov = self._sensitivity.covariances(*known, self.with_parameters)
        self._force_cov_out = force_bytes if self._no_force else self._nine.pack(*force_cov.ravel().tolist())
        self._rate_cov_out = rate_bytes if self._no_rate else self._nine.pack(*rate_cov.ravel().tolist())
        self._rate_cov_in, self._force_cov_in = rate_bytes, data[self._force_at + 24:]

    def _without_absent(self, wx, wy, wz, fx, fy, fz):
        """Return the readings with what an absent sensor would read at zero input, so that it does not disturb the other one."""
        if self._no_rate:
            wx, wy, wz = self._zero['gyroscope']
        if self._no_force:
            fx, fy, fz = self._zero['accelerometer']
        return wx, wy, wz, fx, fy, fz

    def _with_absent(self, data, vx, vy, vz, ux, uy, uz):
        """Return the corrected readings, with those of an absent sensor as they came."""
        came = self._readings.unpack_from(data, self._rate_at)
        return (*(came[:3] if self._no_rate else (vx, vy, vz)), *(came[3:] if self._no_force else (ux, uy, uz)))

    def _marked(self, force, rate, rate_cov, force_cov):
        """Return the covariances, of the size of the range where a sensor is saturated: the true value is not known better."""
        force_level, rate_level = self._levels
        if force < force_level and rate < rate_level:
            return rate_cov, force_cov
        self.counts['saturated'] += 1
        return (self._mark(rate_level) if rate >= rate_level else rate_cov, self._mark(force_level) if force >= force_level else force_cov)

    def _mark(self, level):
        return self._nine.pack(*(np.eye(3) * level**2).ravel().tolist())

    def _reheaded(self, data, stamp_ns):
        """Return everything before the rate: moved stamp, new frame, turned orientation."""
        stamp = self._stamp.pack(*divmod(stamp_ns - self._late_ns, NS))
        orientation, covariance = data[self._body:self._body + 32], data[self._body + 32:self._rate_at]
        if self.transfer is None:
            return data[:STAMP_AT] + stamp + data[HEAD_AT:self._rate_at]
        if covariance != self._orientation_cov_in:
            given = np.array(self._nine.unpack(covariance)).reshape(3, 3)
            self._no_orientation, self._orientation_cov_in = given[0, 0] == ABSENT, covariance
            mat_ts = self.transfer.mat_ts
            turned = given if self._no_orientation else mat_ts @ given @ mat_ts.T
            self._orientation_cov_out = self._nine.pack(*turned.ravel().tolist())
        if not self._no_orientation:
            orientation = self._four.pack(*_product(self._four.unpack(orientation), self._quaternion_st))
        return data[:STAMP_AT] + stamp + self._head_out + orientation + self._orientation_cov_out

    def _warm_up(self, stamp_ns):
        """Gather stamps until the period is known; the angular acceleration counts as zero so long."""
        self._steps.append(stamp_ns)
        if len(self._steps) > WARM_UP:
            period = typical_period(self._steps)
            self._steps = []
            if period is not None:
                self._settle(period)
        return NO_SLOPE

    def _settle(self, period):
        self.period = period
        if self.needs_slope:
            self._tracker = StampedDerivative(derivative_for(self.calibration, period, self.transfer))
            self._push = self._tracker.push
            self._make_uncertainty(self.derivative)

    def _make_uncertainty(self, derivative):
        self._uncertainty = Uncertainty(self.calibration, self.transfer, derivative)
        if self.transfer is not None:
            from scipy.spatial.transform import Rotation
            self._quaternion_st = tuple(Rotation.from_matrix(self.transfer.mat_ts.T).as_quat().tolist())
        self.refresh()


def _product(p, q):
    """Return the product of quaternions (x, y, z, w); zeros stay zeros."""
    px, py, pz, pw = p
    qx, qy, qz, qw = q
    return (pw * qx + px * qw + py * qz - pz * qy, pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw, pw * qw - px * qx - py * qy - pz * qz)
