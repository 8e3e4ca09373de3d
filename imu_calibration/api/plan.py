"""Plan the motions of a table or an arm from the requirements on its IMU."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from imu_calibration.api.choices import calibration_options
from imu_calibration.api.recordings import Stand
from imu_calibration.api.references import reference_of
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.core import documents
from imu_calibration.core.errors import DocumentError, InputError
from imu_calibration.core.exit_codes import exit_code_of
from imu_calibration.core.progress import report
from imu_calibration.core.units import DEG, STANDARD_GRAVITY, STANDARD_GRAVITY_SD
from imu_calibration.document import files
from imu_calibration.document.calibration import Calibration, listed
from imu_calibration.effects.sensor_model import BASE, SensorModel, parse_effects
from imu_calibration.estimation.solution import GRAVITY, REMEDIES, tolerances_of
from imu_calibration.kinematics.joint import JointNames
from imu_calibration.kinematics.motion_limits import (
    NOT_CHECKED,
    MotionLimits,
    limit_words,
    limits_of,
    missing_ranges,
    range_warnings,
)
from imu_calibration.kinematics.table import Table
from imu_calibration.planning.campaign import LONGEST_SEPARATION, make_separator
from imu_calibration.planning.planner import (
    Plan,
    make_planner,
    plan_by_hand,
    plan_to_mapping,
    trajectory_to_mapping,
)
from imu_calibration.planning.planning_problem import expected_noise
from imu_calibration.references.gravity.hand_parameters import HandModel
from imu_calibration.references.turntable.table_calibration import calibration_of_saved
from imu_calibration.report.figures import Drawn

ACCUMULATOR = '.npz'
"""Suffix of the accumulator that a live session saves with its calibration."""
TRAJECTORIES = ('trajectory', 'trajectory.yaml')
"""Names of the bag and the file with the motions of a plan."""
PLAN_START_NS = 1_000_000_000
"""First stamp of the bag with the trajectories: any, but the same every time."""


@dataclass(frozen=True, eq=False)
class Planned:
    """
    A plan: prints its predicted accuracy, draws itself, and saves its files.

    It saves plan.yaml, the trajectory and report.html.
    """

    plan: Plan
    """Motions, predicted standard deviations, time and its lower bound."""
    provenance: dict[str, Any]
    """Options of the plan, for its file."""
    unbounded: Sequence[str] = ()
    """Joints without a range."""
    notes: Sequence[str] = ()
    """Checks and doubts about the limits, and an unknown gravity, a line each."""

    @property
    def exit_code(self) -> int:
        """
        0 when every parameter reaches its tolerance and every joint is bounded, else 3.

        A joint is bounded when it has a range or is declared endless.
        """
        return exit_code_of(self.reasons)

    @property
    def reasons(self) -> list[str]:
        """Why the exit code is 3, a line each."""
        lines = []
        if self.plan.missing:
            lines.append(f'above the tolerance after this plan: {listed(self.plan.missing)}')
        if self.unbounded:
            lines.append(f'joints without a range: {", ".join(self.unbounded)}')
        return lines

    @cached_property
    def report(self) -> str:
        """The report as one HTML page."""
        from imu_calibration.report.plan_page import plan_report

        report('drawing the report')
        return plan_report(self.plan, self.provenance)

    def plot(self) -> Drawn:
        """
        Return the standard deviations against time, in tolerances, as a figure for a notebook.
        """
        from imu_calibration.report.plan_page import draw_progress

        return draw_progress(self.plan)

    def save(
        self,
        folder: str | PathLike,
        *,
        report: bool = True,
        storage: str = 'sqlite3',
        force: bool = False,
    ) -> None:
        """
        Write plan.yaml, and trajectory.yaml and the bag `trajectory` for joints.

        The bag has a message per motion, and report.html is written when wanted. An existing plan
        is replaced only with `force`; its trajectory is then moved to the next free name.
        """
        from msg_adapters.write import write_trajectories

        require_no_plan(folder, report=report, force=force)
        place = files.make_folder(folder)
        moves_joints = bool(self.plan.moved_joints)
        # Made before a file is replaced: after an error the earlier plan is unchanged.
        text = documents.to_text(plan_to_mapping(self.plan, self.provenance))
        page = self.report if report else ''

        # A trajectory of an earlier plan does not belong to this one.
        for name in TRAJECTORIES:
            if (place / name).exists():
                files.put_aside(place / name)
        if moves_joints:
            write_trajectories(place / 'trajectory', self._messages(), storage=storage)
        if report:
            files.write_text(place / files.REPORT, page)
        if moves_joints:
            files.write_text(
                place / 'trajectory.yaml',
                documents.to_text(trajectory_to_mapping(self.plan.points)),
            )
        files.write_text(place / 'plan.yaml', text)

    def _messages(self) -> list[tuple[int, Any]]:
        """Return (stamp in ns, JointTrajectory) of each motion of the joints."""
        from imu_calibration.planning.motion_library import trajectory

        names = self.plan.moved_joints
        begins = np.concatenate([[0.0], self.plan.ends[:-1]])
        messages = []
        for begin, segments in zip(begins, self.plan.segments, strict=True):
            if segments:
                stamp_ns = PLAN_START_NS + round(float(begin) * 1e9)
                messages.append((stamp_ns, trajectory(names, segments)))
        return messages

    def __str__(self):
        return '\n'.join([*plan_summary(self.plan), *self.notes])


def require_no_plan(folder: str | PathLike, *, report: bool, force: bool) -> None:
    """Refuse to replace an existing plan without consent; raises as `files.require_new`."""
    names = ['plan.yaml', *TRAJECTORIES]
    if report:
        names.append(files.REPORT)
    for name in names:
        files.require_new(Path(folder) / name, force=force)


def plan(
    stand: Stand | None,
    *,
    calibration: str | PathLike | Calibration | None = None,
    grade: str = 'industrial',
    imu_rate: float = 100.0,
    separate: Sequence[str] = (),
    diagnosis: str | PathLike | Mapping[str, Any] | None = None,
    around: Mapping[str, float] | None = None,
    reach: float | None = None,
    longest: float = LONGEST_SEPARATION,
    with_bound: bool = True,
    **choices: Any,
) -> Planned:
    """
    Plan the motions that bring every parameter within its tolerance.

    Parameters
    ----------
    stand : path-like, Table or Arm
        The moving joints, with their limits.
    calibration : path-like or Calibration, optional
        Prior data: a calibration, or the accumulator (.npz) that a live session on the same joints
        saved.
    grade : str
        Grade of the IMU, where no noise is given.
    imu_rate : float
        Samples of the IMU per second.
    separate : sequence of str
        Effects to separate, the one that `calibration` contains first: the plan separates them
        instead of reaching the tolerances.
    diagnosis : path-like or mapping, optional
        diagnosis.json or its content, of which the first finding with equivalent effects is used.
    around : mapping, optional
        Joint -> position, degrees (m where it slides), of every joint: the motion keeps to `reach`
        about this pose, where it begins.
    reach : float, optional
        Degrees to either side; prismatic joints do not move.
    longest : float
        Longest duration of a plan that separates effects, s.
    with_bound : bool
        Whether the lower bound on the time is computed; a plan well above it is searched a second
        time.
    choices
        tolerances, noise, accelerometer_model, gyroscope_model, reference_model, catalogue,
        gravity: see `Choices`.

    Raises
    ------
    InputError
        When the joints cannot move, or names do not match.

    """
    report('planning')
    # The moving joints, their limits, and the noise that is expected of the IMU.
    options = calibration_options(choices)
    reference = reference_of(stand, options=options)
    table = reference.table_for('a plan of motions needs a table or a robot description')
    noise = expected_noise(options.noise, grade, imu_rate)
    limits = limits_of(table)
    start = None
    if around or reach is not None:
        limits, start = _neighbourhood(limits, table.joint_names, around or {}, reach)

    # Prior data, and the effects to separate: requested ones, or collinear ones of a diagnosis with
    # their sizes.
    prior = _prior_calibration(calibration, table, options)
    effects = tuple(separate)
    sizes = {}
    if diagnosis and not separate:
        if isinstance(diagnosis, Mapping):
            effects, sizes = class_in(diagnosis)
        else:
            effects, sizes = files.read_mapping(diagnosis, 'diagnosis', class_in)

    # Separate effects, or determine every parameter.
    conditions: dict[str, Any] = {
        'noise': noise,
        'rate': imu_rate,
        'options': options,
        'limits': limits,
    }
    if not effects:
        planner = make_planner(table, calibration=prior, **conditions)
    elif prior is None:
        raise InputError(
            'separation of effects needs the calibration of the diagnosis with the finding,'
            ' none was given; give it',
            key='calibration',
        )
    else:
        keys = [(options.catalogue.owner_of(name, table.joint_names), name) for name in effects]
        planner = make_separator(table, prior, keys, sizes=sizes, **conditions)

    known = 'a calibration' if prior else 'nothing'
    if isinstance(calibration, (str, PathLike)):
        known = Path(calibration).name
    provenance = {
        **_stated_noise(options, grade, imu_rate),
        'known': known,
        'checked': NOT_CHECKED,
        'limits': '; '.join(limit_words(table, limits)),
    }
    warnings = range_warnings(table)
    if warnings:
        provenance['warnings'] = '; '.join(warnings)
    if effects:
        provenance['tells_apart'] = ', '.join(effects)
    return Planned(
        planner.plan(start, with_bound=with_bound, longest=longest if effects else np.inf),
        provenance,
        unbounded=missing_ranges(table),
        notes=notes_on(table),
    )


def _stated_noise(options: CalibrationOptions, grade: str, imu_rate: float) -> dict[str, Any]:
    """Return the source of the noise and the sampling rate (Hz), for the file of a plan."""
    return {'noise': grade if options.noise is None else 'as identified', 'imu_rate': imu_rate}


def notes_on(table: Table) -> list[str]:
    """Return the notes of a plan for a table, a line each."""
    lines = [NOT_CHECKED, *(f'warning: {line}' for line in range_warnings(table))]
    # No motion determines the scales better than gravity is known. The remedies are listed by sets
    # of terms, here the one of gravity.
    gravity_sd = table.gravity_sd_value
    if gravity_sd >= STANDARD_GRAVITY_SD:
        share = gravity_sd / table.gravity_value
        lines.append(
            f'warning: the scales of the accelerometer are known to {100 * share:.2g} %, as'
            f' gravity is; {REMEDIES[GRAVITY,]}'
        )
    return lines


def _neighbourhood(
    limits: MotionLimits, names: Sequence[str], around: Mapping[str, float], reach: float | None
) -> tuple[MotionLimits, np.ndarray]:
    """
    Return (limits restricted to `reach` degrees about a pose, positions of the pose).

    Positions are in rad, or m where a joint slides, shape (n_joints,).
    """
    if reach is None or reach <= 0 or set(around) != set(names):
        raise InputError(
            'a neighbourhood must have a reach above 0 and a position of every joint'
            f' ({", ".join(names)}), got reach {reach} and {", ".join(around) or "no joint"}; give'
            ' both'
        )
    position = np.where(limits.turns, DEG, 1.0) * [around[name] for name in names]
    return limits.reached(position, reach), position


def _prior_calibration(
    calibration: str | PathLike | Calibration | None, table: Table, options: CalibrationOptions
) -> Calibration | None:
    """Return the prior data: given, from a calibration file, or from a saved accumulator."""
    if not isinstance(calibration, (str, PathLike)):
        return calibration
    if Path(calibration).suffix != ACCUMULATOR:
        return files.read_calibration(calibration)
    try:
        return calibration_of_saved(files.read_bytes(calibration, 'accumulator'), table, options)
    except DocumentError as error:
        raise error.named(str(calibration)) from error


def by_hand(*, grade: str = 'industrial', imu_rate: float = 100.0, **choices: Any) -> Planned:
    """
    Plan the poses and turns of a calibration without a table.

    Parameters
    ----------
    grade : str
        Grade of the IMU, where no noise is given.
    imu_rate : float
        Samples of the IMU per second.
    choices
        tolerances, noise, accelerometer_model, gyroscope_model, catalogue, gravity: see `Choices`.

    """
    options = calibration_options(choices)
    catalogue = options.catalogue
    base = '+'.join(BASE)
    accelerometer = parse_effects(
        'accelerometer', options.accelerometer_model or base, catalogue=catalogue
    )
    gyroscope = parse_effects('gyroscope', options.gyroscope_model or base, catalogue=catalogue)
    sensors = SensorModel(
        accelerometer, gyroscope, joint_names=JointNames.of(()), catalogue=catalogue
    )
    model = HandModel(sensors, options.gravity or STANDARD_GRAVITY)
    noise = expected_noise(options.noise, grade, imu_rate)
    report('planning')
    tolerances = tolerances_of(sensors, options.tolerances)
    return Planned(
        plan_by_hand(model, tolerances=tolerances, noise=noise, rate=imu_rate),
        {**_stated_noise(options, grade, imu_rate), 'reference': 'gravity, by hand'},
    )


def class_in(document: Mapping[str, Any]) -> tuple[tuple[str, ...], dict[str, float]]:
    """
    Return (first class of collinear effects in a diagnosis, parameter -> value in SI).

    The finding is the first effect of the class. The values are those of the other effects.

    Raises
    ------
    InputError
        When every finding has a single name.

    """
    for finding in document.get('findings') or ():
        mates = finding.get('indistinguishable_from')
        if mates:
            sizes = {}
            for sizes_of_mate in finding.get('sizes_of_mates', {}).values():
                for parameter, size in sizes_of_mate.items():
                    sizes[parameter] = float(size['value'])
            return (finding['effect'], *mates), sizes
    raise InputError(
        'the diagnosis must have a finding with collinear effects, it has none; no effects need to'
        ' be separated',
        code='nothing_to_separate',
    )


def plan_summary(plan: Plan) -> list[str]:
    """Return the predictions of a plan, a line each."""
    if plan.told_apart:
        first_line = f'{len(plan.motions)} motions in {plan.seconds:.0f} s'
        if not plan.missing:
            return [f'{first_line} separate {plan.told_apart}']
        return [
            first_line,
            (
                'at their assumed sizes, no motion of these joints in that time separates:'
                f' {", ".join(plan.missing)}'
            ),
        ]
    n_wanted = int(plan.wanted.sum())
    n_determined = n_wanted - len(plan.missing)
    lines = [
        f'{len(plan.motions)} {plan.noun} in {plan.seconds:.0f} s; {n_determined} of {n_wanted}'
        ' parameters are within their tolerance'
    ]
    if plan.missing:
        lines.append(f'outside their tolerance {plan.scope}: {", ".join(plan.missing)}')
    elif np.isfinite(plan.lower_bound_seconds) and plan.lower_bound_seconds > 0:
        lines.append(
            'every plan of these motions with the same probability (95 %) needs at least'
            f' {plan.lower_bound_seconds:.0f} s'
        )
    return lines
