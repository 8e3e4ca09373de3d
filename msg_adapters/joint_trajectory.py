"""trajectory_msgs/JointTrajectory: command to the joints, to a message and back."""

import struct
from typing import Any

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.kinematics.motion_limits import TrajectoryPoints
from msg_adapters.stamps import NS_PER_S

JOINT_TRAJECTORY_TYPE = 'trajectory_msgs/msg/JointTrajectory'
_FIELDS = {'position': 'positions', 'rate': 'velocities', 'acceleration': 'accelerations'}


def encode_trajectory(points: TrajectoryPoints, frame_id: str = '', stamp_ns: int = 0) -> bytes:
    """
    Return TrajectoryPoints as plain little-endian CDR.

    Parameters
    ----------
    points : TrajectoryPoints
    frame_id : str
    stamp_ns : int
        When the trajectory begins; 0: when it arrives.

    """
    writer = _Writer()
    writer.numbers('iI', *divmod(stamp_ns, NS_PER_S))
    writer.string(frame_id)
    writer.numbers('I', len(points.joint_names))
    for name in points.joint_names:
        writer.string(name)
    writer.numbers('I', len(points))
    columns = points.columns()
    for k, time in enumerate(points.time):
        for name in _FIELDS:
            writer.doubles(columns[name][k] if name in columns else ())
        writer.doubles(())   # effort
        writer.numbers('iI', *divmod(round(time * NS_PER_S), NS_PER_S))
    return bytes(writer.data)


def trajectory_from_message(message: Any) -> TrajectoryPoints:
    """
    Return the TrajectoryPoints of a message object of rclpy or rosbags.

    Velocities or accelerations that not every point has count as not given, as in the controller's spline.

    Raises
    ------
    InputError
        When a position is missing, or the points are none that a controller would follow.

    """
    names, points = tuple(message.joint_names), message.points
    time = np.array([point.time_from_start.sec + point.time_from_start.nanosec * 1e-9 for point in points], float)
    given = {name: [list(getattr(point, field)) for point in points] for name, field in _FIELDS.items()}
    complete = {name: np.array(values, float).reshape(len(points), len(names)) for name, values in given.items()
                if all(len(row) == len(names) for row in values) and (values or name == 'position')}
    if 'position' not in complete:
        raise InputError(f'each point of a trajectory must have {len(names)} positions, one for each joint, some have not; '
                         'give them all', code='position_count')
    return TrajectoryPoints(names, time, **complete)


class _Writer:
    """Writes consecutive numbers, each aligned to its size relative to the end of the encapsulation."""

    def __init__(self):
        self.data = bytearray(b'\0\x01\0\0')

    def _align(self, size):
        self.data += bytes(-(len(self.data) - 4) % size)

    def numbers(self, kinds, *values):
        self._align(4)
        self.data += struct.pack('<' + kinds, *map(int, values))

    def string(self, text):
        data = text.encode() + b'\0'
        self.numbers('I', len(data))
        self.data += data

    def doubles(self, values):
        self.numbers('I', len(values))
        if len(values):
            self._align(8)
            self.data += np.asarray(values, '<f8').tobytes()
