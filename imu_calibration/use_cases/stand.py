"""The carrier of the IMU, a table or an arm, and its chain of joints for a recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import SampleBlock
from imu_calibration.document import files
from imu_calibration.kinematics.table import Table
from imu_calibration.kinematics.urdf import root_of, table_from_urdf, up_of
from imu_calibration.use_cases.recordings import Topics, existing
from msg_adapters.bag import description_in, frame_of, static_transforms

LIKELY_LINK = 'imu_link'
"""The IMU's link where no recording names its frame."""
DESCRIPTIONS = ('.urdf', '.xacro')
"""Endings of files that describe robots."""


@dataclass(frozen=True, eq=False)
class Arm:
    """A robot that carries the IMU; missing entries are read from a recording."""

    urdf: str | PathLike | None = None
    """Robot description (.urdf or .xacro); None: that on the topic /robot_description of the recording."""
    imu_link: str | None = None
    """Link that carries the IMU; None: the frame of its messages."""
    site: str | PathLike | Mapping[str, Any] | None = None
    """Entries of a table description other than the joints: file or mapping; its joints may give limits by name."""
    up: Sequence[float] | None = None
    """Up in the frame of the root; None: from the site, otherwise from /tf_static of the recording, otherwise z."""
    allow_xacro: bool = False
    """Whether a .xacro file may be expanded, which runs its expressions as Python code."""


Stand = str | PathLike | Table | Arm
"""A table description or a robot description (file), a table, or an arm."""


def table_of(stand: Stand, recordings: Sequence[str | PathLike | SampleBlock] = (), topics: Topics = Topics(), *,
             gravity: float | None = None) -> Table:
    """
    Return the chain of joints of a table or an arm.

    Parameters
    ----------
    stand : path-like, Table or Arm
    recordings : sequence
        The first one gives the IMU's frame, the attitude of a robot's root, and its description where no file is named.
    topics : Topics
        Topics of the recordings.
    gravity : float, optional
        Local gravity for a robot whose site does not give it, m/s^2.

    Raises
    ------
    InputError
        When a file cannot be used, or required data are not in the recordings.

    """
    if isinstance(stand, Table):
        return stand
    if not isinstance(stand, Arm):
        if Path(stand).suffix not in DESCRIPTIONS:
            return files.read_table(stand)
        stand = Arm(stand)
    site = dict(stand.site or {}) if isinstance(stand.site, Mapping | None) else files.read_mapping(stand.site, 'table description')
    bag = next(((str(existing(item)), topics.imu) for item in recordings if not isinstance(item, SampleBlock)), None)
    text = _description(stand, bag)
    if stand.up is not None:
        site['up'] = list(stand.up)
    elif bag is not None and site.get('up') is None:
        site['up'] = list(up_of(root_of(text), static_transforms(*bag)))
    if gravity is not None and site.get('gravity') is None:
        site['gravity'] = gravity
    return table_from_urdf(text, stand.imu_link or topics.frame or _frame(recordings, bag), site)


def _description(arm, bag):
    """Return the text of the robot description: of the file, otherwise of the recording's topic."""
    if arm.urdf is not None:
        return files.read_robot_description(arm.urdf, arm.allow_xacro)
    if bag is None:
        raise InputError('the description of the robot whose link was named must be given, got none; give the file', key='urdf')
    return description_in(*bag)


def _frame(recordings, bag):
    if bag is not None:
        return frame_of(*bag)
    return next((item.imu.frame_id for item in recordings if isinstance(item, SampleBlock) and item.imu is not None), LIKELY_LINK)
