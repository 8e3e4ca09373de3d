"""Export of a calibration to a target."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pkgutil import iter_modules

import numpy as np

import imu_calibration
from imu_calibration.allan.document import BASIS
from imu_calibration.allan.figures import MIN_WALK_REST, Densities, NoiseFigures
from imu_calibration.core.errors import InputError, did_you_mean
from imu_calibration.core.exit_codes import exit_code_of
from imu_calibration.core.units import error_text
from imu_calibration.document.calibration import Calibration
from imu_calibration.document.calibration_text import calibration_mapping
from imu_calibration.document.exports import targets
from imu_calibration.document.exports.affine import (
    ARMS,
    FRD,
    MATRICES,
    UNNAMED,
    Placement,
    affine_of,
    calibration_moved,
    forward_right_down,
    pose_line,
)
from imu_calibration.document.exports.loss import (
    ROUNDING_LOSS,
    Loss,
    TrialMotion,
    loss_of,
    standard_motion,
)
from imu_calibration.document.exports.target import Noise, Numbers, Page, Readings, Target
from imu_calibration.document.trust import (
    Usable,
    cautions_of,
    caveats,
    refused_sensors,
    usable,
)
from imu_calibration.effects.base import SENSORS, UNITS, Role


@dataclass(frozen=True, eq=False)
class Export:
    """A file for a target."""

    content: bytes
    """The file."""
    numbers: Numbers
    """The numbers of the calibration in it."""
    placement: Placement
    """Frame, origin and axes of these numbers."""
    loss: Loss
    """Loss of the export."""
    lines: tuple[str, ...]
    """Notes: the same in the file and on the terminal."""
    used: Usable
    """The calibration with the sensors that the numbers correct, and those refused."""

    @property
    def refused(self) -> Mapping[str, str]:
        """Sensor whose numbers are those of a data sheet -> why."""
        return self.used.refused

    @property
    def exit_code(self) -> int:
        """0 where the decision on each sensor is `helps`, otherwise 3, as of `compensate`."""
        return exit_code_of(self.reasons)

    @property
    def reasons(self) -> list[str]:
        """Why the exit code is 3, a line each."""
        return self.used.lines


def export(
    calibration: Calibration,
    target: Target,
    *,
    noise: NoiseFigures | None = None,
    rate: float | None = None,
    motion: TrialMotion | None = None,
    anyway: bool = False,
) -> Export:
    """
    Return the file of a target.

    A sensor that compensation does not correct has the nominal numbers; its loss is the whole error
    by the calibration. For a target that contains the complete document, with its decisions.

    Parameters
    ----------
    calibration : Calibration
    target : Target
    noise : NoiseFigures, optional
        From a noise document; without one the white noise of the calibration's recording is used,
        without random walks.
    rate : float, optional
        Rate at which the target gets the readings, Hz; default that of the noise document.
    motion : TrialMotion, optional
        Where the loss is measured; default `standard_motion`.
    anyway : bool
        Also the numbers of a sensor whose decision is `harms`.

    Raises
    ------
    InputError
        When the target needs noise that is not there, or the calibration cannot be brought into its
        axes.
    DocumentError
        When no sensor should be corrected with the calibration.

    """
    if target.whole:
        # The file has the decisions too; a refused sensor is nevertheless a reason for exit code 3.
        refused = refused_sensors(calibration, anyway=anyway)
        used = Usable(calibration, refused, cautions_of(calibration, refused))
    elif target.only_noise:
        used = Usable(calibration)
    else:
        used = usable(calibration, anyway=anyway)
    # Without the corrections of refused sensors; the loss below is against the complete
    # calibration.
    applied = used.calibration
    if rate is not None and not 0 < rate < np.inf:
        raise InputError(
            f'the rate must be above zero, got {rate:g} Hz; correct it', code='rate_not_positive'
        )

    # Numbers of the file, and their loss.
    noise_numbers, noise_notes = _noise_numbers(applied, target, noise, rate)
    placement, numbers = placed_numbers(applied, target)
    motion = motion or standard_motion(applied)
    loss = loss_of(target, calibration, numbers, placement=placement, motion=motion)

    # Lines for the user, which the file has as comments.
    notes = [f'the {sensor} was not calibrated' for sensor in applied.absent]
    notes += [f'of the calibration: {line}' for line in (*used.lines, *caveats(applied))]
    notes += [*target.ignored(numbers), *noise_notes]
    if target.hint:
        notes.append(target.hint)
    lines = [
        *_placement_lines(applied, target, placement),
        *_worked_sample(target, numbers, placement, applied),
        *loss_lines(target, loss, applied.sensors),
        *(f'note: {note}' for note in notes),
    ]
    head = [
        f'{target.title}, written by imu_calibration {imu_calibration.__version__}',
        *target.formula.splitlines(),
        f'({target.source})',
    ]
    rate = rate or (noise.rate if noise else None)
    assert target.write is not None  # `find_target` gives no other
    content = target.write(Page(numbers, noise_numbers, [*head, *lines], applied, rate))
    return Export(
        content=content.encode() if isinstance(content, str) else content,
        numbers=numbers,
        placement=placement,
        loss=loss,
        lines=tuple(lines),
        used=used,
    )


def placed_numbers(calibration: Calibration, target: Target) -> tuple[Placement, Numbers]:
    """Return the placement of a target for a calibration and the numbers there."""
    if target.whole:
        return Placement(), calibration_mapping(calibration)
    representable = affine_of(calibration, target.holds)
    if target.forward_right_down:
        placement = forward_right_down(calibration.readings)
    else:
        # A target that has only the diagonals chooses its axes by the full matrices too.
        geometry = MATRICES
        if np.any(representable.arms):
            geometry = MATRICES + ARMS
        placement = target.placement(affine_of(calibration, geometry))
    return placement, target.numbers(calibration_moved(representable, placement))


def _noise_numbers(
    calibration: Calibration, target: Target, figures: NoiseFigures | None, rate: float | None
) -> tuple[Numbers | None, list[str]]:
    """
    Return (noise in the target's terms, notes on unknown figures).

    The noise is None if the target has none, or needs figures that are not known.
    """
    if target.noise is None:
        return None, []
    noise = _noise_of(calibration, figures, rate)
    # Without figures a file with other numbers is written without noise.
    if noise is None or (target.needs_walk and not noise.walk_known):
        lacks = 'noise, or the rate of the readings of the calibration,'
        if target.needs_walk:
            lacks = 'noise with random walks'
        if target.only_noise:
            raise InputError(
                f'for {target.title} there must be {lacks} and there is none; give a noise'
                ' document',
                key='noise',
                code='noise_missing',
            )
        return None, [
            f'the noise figures are left out: there must be {lacks} from a noise document'
        ]
    notes = []
    if target.needs_walk:
        if figures is not None:
            _require_rest_for_walk(figures)
        for sensor in SENSORS:
            basis = getattr(noise, sensor).basis
            if basis != 'walk':
                notes.append(f'random walk of the {sensor}: {BASIS[basis]}')
    return target.noise(noise), notes


def _require_rest_for_walk(figures: NoiseFigures) -> None:
    """Refuse the random walk of a rest in which none can be seen; imported figures have no rest."""
    seconds = figures.recording.get('seconds_at_rest')
    if seconds is None or seconds >= MIN_WALK_REST:
        return
    raise InputError(
        f'a random walk must be measured in at least {MIN_WALK_REST:.0f} s of rest, that of the'
        f' noise document is from {seconds:.0f} s; record a longer rest, or export without a noise'
        ' document',
        key='noise',
        code='rest_too_short_for_walk',
    )


def _noise_of(
    calibration: Calibration, figures: NoiseFigures | None, rate: float | None
) -> Noise | None:
    """
    Return the noise of a noise document, or else the white noise of the calibration.

    The latter needs a rate; None without one, or if the calibration has no noise of a sensor.
    """
    if figures is not None:
        figures.require_both_sensors('record both sensors, or export without it')
        densities = {sensor: figures.densities(sensor) for sensor in SENSORS}
        unbounded = [sensor for sensor in SENSORS if not np.isfinite(densities[sensor].walk)]
        if unbounded:
            raise InputError(
                'the noise document must bound the random walk of both sensors, that of the'
                f' {" and ".join(unbounded)} has no bound; record a longer rest',
                key='noise',
                code='walk_unbounded',
            )
        return Noise(densities['accelerometer'], densities['gyroscope'], rate or figures.rate)
    # Of the noisiest axis.
    sample_sd = {sensor: float(calibration.noise(sensor)[0].max()) for sensor in SENSORS}
    if rate is None or not all(sample_sd.values()):
        return None
    # Density of white noise: sd of a sample / sqrt(rate).
    root = float(np.sqrt(rate))
    # The random walk is unknown: `walk_known` marks the zero as a placeholder.
    accelerometer = Densities(sample_sd['accelerometer'] / root, 0.0, 'bound')
    gyroscope = Densities(sample_sd['gyroscope'] / root, 0.0, 'bound')
    return Noise(accelerometer, gyroscope, rate, walk_known=False)


def _placement_lines(calibration: Calibration, target: Target, placement: Placement) -> list[str]:
    """Describe the frame of the numbers relative to the sensor frame."""
    if target.only_noise:
        return []
    name = calibration.frame_id or UNNAMED
    if not np.array_equal(placement.mat_readings, np.eye(3)):  # an autopilot
        if np.array_equal(placement.mat_readings, FRD):
            return [f'frame: forward-right-down, x as in {name}, y and z reversed, readings too']
        rows = ', '.join(_axis(row) for row in placement.mat_readings)
        return [f'frame: forward-right-down, the axes {rows} of {name}, readings too']
    if np.array_equal(placement.mat_ts, np.eye(3)) and not np.any(placement.origin_s):
        if target.forward_right_down:
            return [f'frame: {name}, forward-right-down as its readings']
        return [f'frame: {name}, axes as in the calibration']
    child = f'{name}_{target.name}'
    return [
        (
            f"frame: {child}, turned and moved against {name} as the target's conventions demand;"
            ' extrinsics change with it:'
        ),
        f'  {pose_line(placement, name, child)}',
    ]


def _axis(row: np.ndarray) -> str:
    """Return the axis of the source, with its sign, that a row of a signed permutation selects."""
    index = int(np.argmax(np.abs(row)))
    if row[index] < 0:
        return f'-{"xyz"[index]}'
    return 'xyz'[index]


def _worked_sample(
    target: Target, numbers: Numbers, placement: Placement, calibration: Calibration
) -> list[str]:
    """Show one reading before and after the target's formula."""
    if target.whole or target.only_noise or target.estimates:
        return []
    temperature = np.array([calibration.model.temperature_ref_c])
    raw_force = np.array([[0.5, -0.3, 9.7]])
    raw_rate = np.array([[0.1, -0.2, 0.3]])
    force, rate = placement.readings(raw_force, raw_rate)
    readings = Readings(force, rate, alpha=np.zeros((1, 3)), temperature_c=temperature)
    corrected = target.corrected(numbers, readings)
    texts = []
    for vectors in (force, rate, *corrected):  # shape (1, 3)
        components = ', '.join(f'{value:.9g}' for value in vectors[0])
        texts.append(f'[{components}]')
    return [
        f'worked sample: readings {texts[0]} m/s^2, {texts[1]} rad/s become {texts[2]}, {texts[3]}'
    ]


def loss_lines(target: Target, loss: Loss, sensors: Sequence[str] = SENSORS) -> list[str]:
    """Return a line for each lost effect, and for the remaining error of each of `sensors`."""
    # A program without a calibration has the complete error of the readings.
    if target.only_noise:
        remaining = ', '.join(
            f'{sensor} {error_text(rms, UNITS[sensor])}' for sensor, rms in loss.remaining.items()
        )
        addition = ' in addition to a constant bias' if target.estimates else ''
        return [
            (
                'accepts no calibration: use compensated readings (compensator_node, or the verb'
                ' compensate)'
            ),
            (
                f'fed with raw readings it is left with an error of rms {remaining}{addition}, on'
                f' {loss.motion}'
            ),
        ]
    lines = []
    if loss.estimated:
        names = ', '.join(f'{effect.sensor} {effect.name}' for effect in loss.estimated)
        lines.append(f'not written, because the target estimates it while it runs: {names}')
    if loss.nothing:
        return [*lines, 'lost: nothing']
    for lost in loss.effects:
        extent = 'held in part' if lost.in_part else 'lost'
        lines.append(
            f'{extent}: {lost.effect.sensor} {lost.effect.name},'
            f' {error_text(lost.rms, UNITS[lost.effect.sensor])} rms'
        )
    for sensor in sensors:
        remaining = 'none'
        if loss.remaining[sensor] > ROUNDING_LOSS:
            remaining = f'{error_text(loss.remaining[sensor], UNITS[sensor])} rms'
        raw = error_text(loss.raw[sensor], UNITS[sensor])
        lines.append(
            f'remaining error of the {sensor}: {remaining} (raw readings: {raw}), on {loss.motion}'
        )
    return lines


def holds_in_words(target: Target) -> str:
    """Return a short description of a target's capacity."""
    if target.whole:
        return 'everything'
    sensors_of: dict[str, list[str]] = {}  # name of a kind of effect -> sensors
    for capability in target.holds:
        if capability.own_axis:
            name = 'scale factors'
        elif capability.role is Role.LINEAR:
            name = 'matrix'
        else:
            name = capability.effect.heading
        name = name.split(' (')[0].split(':')[0]  # without explanations
        # A heading may begin with its sensor.
        name = name.removeprefix('accel ').removeprefix('gyro ')
        sensors_of.setdefault(name, []).append(capability.sensor)
    parts = []
    for name, sensors in sensors_of.items():
        parts.append(name if len(sensors) == 2 else f'{name} ({sensors[0]})')
    return ', '.join(parts) or '-'


@cache
def all_targets() -> dict[str, Target]:
    """Return every target by name, in alphabetical order."""
    by_name = {}
    for module_info in iter_modules(targets.__path__):
        module = import_module(f'{targets.__name__}.{module_info.name}')
        by_name |= {target.name: target for target in module.TARGETS}
    return dict(sorted(by_name.items()))


def find_target(name: str, *, read: bool = False) -> Target:
    """
    Return the target of a name, whose files can be written, or `read`.

    Raises
    ------
    InputError
        When there is none.

    """
    fitting = {}
    for target in all_targets().values():
        if (target.read if read else target.write) is not None:
            fitting[target.name] = target
    if name not in fitting:
        raise InputError(
            f'the name of a program whose files can be {"read" if read else "written"} is required,'
            f" got '{name}'"
            f'{did_you_mean(name, fitting)}; choose from {", ".join(fitting)}'
        )
    return fitting[name]
