"""
Sessions of a simulated IMU on a motion profile or on the motion of a recording.

A session is kept in memory or written as a bag with the true parameters.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, cast

from imu_calibration.api.choices import Choices, catalogue_of
from imu_calibration.api.recordings import (
    LIKELY_LINK,
    Stand,
    name_of,
    options_of,
    table_of,
)
from imu_calibration.api.references import inputs_of
from imu_calibration.api.resources import config_file
from imu_calibration.core import documents
from imu_calibration.core.progress import report
from imu_calibration.core.readings import RawReadings
from imu_calibration.core.samples import ImuSamples, SampleBlock
from imu_calibration.document import files
from imu_calibration.document.calibration import Calibration, true_calibration
from imu_calibration.document.calibration_text import calibration_to_text
from imu_calibration.effects.base import SENSORS
from imu_calibration.effects.catalogue import Catalogue
from imu_calibration.kinematics.table import Table
from imu_calibration.simulation.profiles import make_profile
from imu_calibration.simulation.replay import BIAS_TIME, ReplayNoise
from imu_calibration.simulation.replay import simulate_on_recording as run_replay
from imu_calibration.simulation.sensor_noise import GRADES
from imu_calibration.simulation.session import (
    SimulationOptions,
    hidden_effect,
    require_joints,
    true_imu,
)
from imu_calibration.simulation.session import simulate_session as run_session

if TYPE_CHECKING:  # in the standard library from Python 3.11 on
    from typing_extensions import Unpack


@dataclass(frozen=True, eq=False)
class Simulated:
    """A session of a simulated IMU on a table."""

    samples: SampleBlock
    """Samples of the IMU, the joints and, with thermal effects, the temperature."""
    table: Table
    """The table as described."""
    truth: Calibration
    """The true parameters."""
    duration: float
    """Length, s."""
    lost: int = 0
    """Samples of a replayed recording without known motion, which are omitted."""

    def save(
        self, path: str | PathLike, *, storage: str = 'sqlite3', compression: str = 'none'
    ) -> None:
        """
        Write a rosbag2 folder ('sqlite3' or 'mcap') with truth.yaml and table.yaml.

        The chunks of an mcap are packed by 'zstd' or 'lz4'.
        """
        from msg_adapters.write import write_session

        report(f'writing {Path(path).name}')
        samples = self.samples
        compression_option = {} if compression == 'none' else {'compression': compression}
        write_session(
            path,
            cast(ImuSamples, samples.imu),
            samples.joints,
            temperature=samples.temperature,
            storage=storage,
            **compression_option,
        )
        files.write_text(Path(path) / 'truth.yaml', calibration_to_text(self.truth))
        files.write_text(Path(path) / 'table.yaml', documents.to_text(self.table.to_mapping()))

    def __repr__(self):
        # A simulation has both streams.
        assert self.samples.imu is not None and self.samples.joints is not None
        return (
            f'<Simulated: {self.duration:.0f} s, {len(self.samples.imu)} Imu,'
            f' {len(self.samples.joints)} JointState>'
        )


def simulate(
    profile: str = 'calibration',
    *,
    table: Stand | None = None,
    calibration: str | PathLike | Calibration | None = None,
    effects: Sequence[str] = (),
    size: float = 0.3,
    grade: str = 'industrial',
    seed: int = 0,
    imu_seed: int | None = None,
    duration: float | None = None,
    imu_rate: float = 100.0,
    joint_rate: float = 100.0,
    encoder_resolution_deg: float = 0.0,
    stamp_jitter_us: float = 0.0,
    temperature: bool = False,
    catalogue: Catalogue | str | PathLike | Mapping | None = None,
) -> Simulated:
    """
    Simulate a session on a turntable.

    Parameters
    ----------
    profile : str
        Motion, see `simulation.profiles`.
    table : path-like or Table, optional
        Default a table with three axes.
    calibration : path-like or Calibration, optional
        The true IMU, table and clock; default a random IMU of the grade.
    effects : sequence of str
        Effects of the catalogue to add, at `size` as a share of the largest plausible one.
    grade : str
        Grade of noise and of the random IMU.
    seed, imu_seed : int
        Of noise and motion, and of the IMU itself: two sessions of one IMU share it.
    duration : float, optional
        Wanted length, s.
    imu_rate, joint_rate : float
        Samples per second.
    encoder_resolution_deg, stamp_jitter_us : float
        Step of the joint positions, deg; standard deviation of the IMU stamps, microseconds.
    temperature : bool
        Whether there is a temperature, which warms up from 25 C; thermal effects bring it too.
    catalogue : Catalogue, path-like or mapping, optional
        The effects that a random IMU may have, or additions to the package's: a file with
        `effects`, or {name: definition}.

    Raises
    ------
    InputError
        When a name is unknown, or table, profile and calibration do not fit together.

    """
    report('simulating')

    # The motion, and the table with the joints that it moves.
    described_table = table_of(table or config_file('table_simulated.yaml'))
    motion = make_profile(profile, seed, described_table, duration=duration)
    moved_table = motion.table_moved(described_table)

    # The true IMU, with the added effects.
    if imu_seed is None:
        imu_seed = seed
    given_imu = None if calibration is None else files.given_calibration(calibration)
    model, values = true_imu(
        moved_table,
        (given_imu.model, given_imu.values) if given_imu else None,
        grade,
        seed=imu_seed,
        catalogue=catalogue_of(catalogue),
    )
    # The point at which a given calibration was linearised is no part of the truth.
    for name in effects:
        sensor, hidden_size = hidden_effect(
            model, name, imu_seed, share=size, moment=0.6 * motion.duration
        )
        model, values = replace(model, point={}).with_sized_effect(
            values, sensor, name, size=hidden_size
        )

    # The samples, with temperatures for thermal effects.
    warms_up = temperature
    for effect in model.effects:
        if effect.name in effects and 'temperature' in effect.needs:
            warms_up = True
    noise = replace(
        GRADES[grade].noise,
        encoder_resolution=math.radians(encoder_resolution_deg),
        stamp_jitter=stamp_jitter_us * 1e-6,
    )
    frame_id = options_of(table).get('imu_link') or LIKELY_LINK
    options = SimulationOptions(
        imu_rate=imu_rate,
        joint_rate=joint_rate,
        noise=noise,
        frame_id=frame_id,
        temperature_start_c=25.0 if warms_up else None,
    )
    samples = SampleBlock(
        *run_session(model, values, moved_table, profile=motion, options=options, seed=seed)
    )
    truth = true_calibration(
        model, values, options.frame_id, simulated={'seed': seed, 'profile': profile}
    )
    return Simulated(samples, moved_table, truth, duration=motion.duration)


def replay(
    recording: str | PathLike | SampleBlock,
    calibration: str | PathLike | Calibration,
    table: Stand | None,
    *,
    seed: int = 0,
    **choices: 'Unpack[Choices]',
) -> Simulated:
    """
    Simulate a calibrated IMU on the motion of a recording.

    The simulation has the joints, stamps, rates and temperature of the recording, and the
    identified noise of the calibration.

    Parameters
    ----------
    recording : path-like or SampleBlock
        Provides joints, stamps and temperature.
    calibration : path-like or Calibration
        The simulated IMU and its noise; without noise in it, the noise at rest of the recording.
    table : path-like, Table or Arm
        The reference.
    seed : int
        Of the noise.
    choices
        See `Choices`; the topics and the gravity apply.

    Raises
    ------
    InputError
        When the table is missing or is not that of the calibration, or no sample has a known
        motion.

    """
    _, reference, (source,) = inputs_of([recording], table, choices)
    given_table = reference.table_for(
        'a replay needs the motion of a table or an arm', 'replay_by_hand'
    )
    calibration = files.given_calibration(calibration)
    require_joints(calibration.model, given_table)
    # The noise of the calibration, if it has that of both sensors.
    statistics = calibration.statistics
    noise = None
    if all('noise_sd' in statistics.get(sensor, {}) for sensor in SENSORS):
        noise = {}
        for sensor in SENSORS:
            sample_sd, wander_sd = calibration.noise(sensor)
            wander_time = statistics[sensor].get('wander_time_s') or BIAS_TIME
            noise[sensor] = ReplayNoise(sample_sd, wander_sd, wander_time)
    report('simulating')
    samples, lost = run_replay(
        source, given_table, calibration.model, values=calibration.values, noise=noise, seed=seed
    )
    truth = replace(
        calibration,
        provenance={'simulated': {'seed': seed, 'replay': name_of(recording)}},
        readings=RawReadings(axes=calibration.readings.axes),
    )
    stamp_ns = cast(ImuSamples, samples.imu).stamp_ns
    duration = 1e-9 * float(stamp_ns[-1] - stamp_ns[0])
    return Simulated(samples, given_table, truth, duration=duration, lost=lost)
