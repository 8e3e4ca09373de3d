"""Choices of the user by name, and the list of effects."""

from collections.abc import Mapping, Sequence
from os import PathLike
from typing import Any, TypedDict

from imu_calibration.allan.figures import NoiseFigures
from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import NominalScaling
from imu_calibration.core.settings import override
from imu_calibration.document import files
from imu_calibration.document.calibration_text import checked_tolerances
from imu_calibration.effects.catalogue import CATALOGUE, Catalogue
from imu_calibration.estimation.observability import MOTIONS
from imu_calibration.kinematics.rotations import local_gravity
from imu_calibration.preprocessing.window import WindowSettings
from imu_calibration.references.options import CalibrationOptions
from imu_calibration.use_cases.recordings import Topics
from imu_calibration.use_cases.resources import config_file


class Choices(TypedDict, total=False):
    """All options have defaults."""

    imu_topic: str | None
    """sensor_msgs/Imu; default /imu/data_raw, otherwise the only one."""
    joint_topic: str | None
    """sensor_msgs/JointState; default /joint_states, otherwise the only one."""
    temperature_topic: str | None
    """sensor_msgs/Temperature; default /imu/temperature, otherwise the only one."""
    frame_id: str | None
    """frame_id of the Imu messages; required if a topic has messages of several."""
    accelerometer_model: str | None
    """A named model or effect names joined by +; default bias+matrix, and accel_size_effect when the rotation shows it."""
    gyroscope_model: str | None
    """The same for the gyroscope; default bias+matrix."""
    reference_model: str | None
    """Effects of table and clock joined by +, or 'none'; default table_tilt, and earth_rate when only the azimuth is unknown."""
    gravity: float | None
    """Local gravity for work by hand or with a robot description, m/s^2; default the standard gravity with its uncertainty."""
    latitude: float | None
    """Geodetic latitude, degrees, from which gravity follows (WGS 84) where it is not given."""
    height: float | None
    """Height above the ellipsoid, m; default 0."""
    model_as_asked: bool
    """Whether the model is used without additions, even where the data support them; default no."""
    tolerances: str | PathLike | Mapping | None
    """File or {section: {effect: standard deviation up to which it counts as determined}}; default config/tolerances.yaml."""
    nominal: str | PathLike | NominalScaling | None
    """File or scaling of recordings in volts or counts."""
    noise: str | PathLike | NoiseFigures | None
    """noise.yaml of this IMU: its bias instability, in place of the estimate from the recording; needs a table."""
    catalogue: Catalogue | str | PathLike | Mapping | None
    """Effects added to the package's, or their complete catalogue: a file with `effects`, or {name: definition}; default the package's."""
    setting: Sequence[str] | Mapping[str, float]
    """How windows are found: 'NAME=NUMBER', ..., or {name: number}."""
    serial: str | None
    """Serial number of the IMU, for the document."""
    operator: str | None
    """Who recorded and calibrated, for the document."""


def check_names(choices: Mapping[str, Any]) -> None:
    """Refuse choices that there are not."""
    strange = sorted(set(choices) - set(Choices.__annotations__))
    if strange:
        raise InputError(f'{", ".join(strange)} cannot be chosen; the choices are {", ".join(Choices.__annotations__)}',
                         code='choice_unknown')


def topics_of(choices: Mapping[str, Any]) -> Topics:
    """Return the topics that were chosen."""
    return Topics(*(choices.get(name) for name in ('imu_topic', 'joint_topic', 'temperature_topic', 'frame_id')))


def calibration_options(choices: Mapping[str, Any]) -> CalibrationOptions:
    """Return the options of estimation and validation."""
    catalogue = catalogue_of(choices.get('catalogue'))
    tolerances = choices.get('tolerances') or config_file('tolerances.yaml')
    read = checked_tolerances if isinstance(tolerances, Mapping) else files.read_tolerances
    gravity, gravity_sd = local_gravity(*(choices.get(name) for name in ('gravity', 'latitude', 'height')))
    return CalibrationOptions(choices.get('accelerometer_model'), choices.get('gyroscope_model'), choices.get('reference_model'),
                              read(tolerances, catalogue), window_settings(choices.get('setting') or ()),
                              nominal_of(choices.get('nominal')), gravity, catalogue, noise_of(choices.get('noise')),
                              as_asked=bool(choices.get('model_as_asked')), gravity_sd=gravity_sd)


def catalogue_of(chosen: Catalogue | str | PathLike | Mapping | None) -> Catalogue:
    """Return the effects that there are, read where they are in a file."""
    if isinstance(chosen, Catalogue):
        return chosen
    if isinstance(chosen, (str, PathLike)):
        return files.read_effects(chosen)
    return CATALOGUE.with_definitions(dict(chosen or {}))


def window_settings(chosen: Sequence[str] | Mapping[str, float]) -> WindowSettings:
    """Return the window settings with the given options."""
    if isinstance(chosen, Mapping):
        return override(WindowSettings(), chosen)
    values = {}
    for pair in chosen:
        name, _, text = pair.partition('=')
        try:
            values[name] = float(text)
        except ValueError as error:
            raise InputError(f"a setting must be NAME=NUMBER, got '{pair}'; write for example settling=1.0", key='setting') from error
    return override(WindowSettings(), values)


def noise_of(chosen: str | PathLike | NoiseFigures | None) -> NoiseFigures | None:
    """Return the noise, read where it is a file."""
    return chosen if chosen is None or isinstance(chosen, NoiseFigures) else files.read_noise(chosen)


def nominal_of(chosen: str | PathLike | NominalScaling | None) -> NominalScaling | None:
    """Return the nominal scaling, read where it is a file."""
    if chosen is None or isinstance(chosen, NominalScaling):
        return chosen
    mapping = files.read_mapping(chosen, 'nominal scaling')
    known = NominalScaling.__dataclass_fields__
    strange = sorted(set(mapping) - set(known))
    if strange:
        raise InputError(f"{chosen} may name {', '.join(known)}; it names {', '.join(strange)}; correct it")
    return NominalScaling(**{name: float(value) for name, value in mapping.items()})


MAX_SHOWN_COLUMNS = 3
"""Columns of an equation that are shown."""


def effect_rows(added: str | PathLike | None = None) -> list[dict[str, Any]]:
    """
    Return one mapping per effect: name, sensor, unit, tolerance, compensation, sentence, equation, required data and motion.

    Raises
    ------
    InputError
        When the file of additional effects cannot be used.

    """
    return [_row(effect) for effect in catalogue_of(added).effects().values()]


def _row(effect):
    units = (effect.unit,) if isinstance(effect.unit, str) else tuple(dict.fromkeys(effect.unit))
    needs = [*effect.needs, *(motion.text for motion in MOTIONS if motion.name in effect.motion)]
    return {'effect': effect.name, 'sensor': effect.sensor, 'unit': ', '.join(units), 'tolerance': effect.tolerance,
            'compensation': effect.compensation, 'text': effect.explanation, 'equation': _equation(effect), 'needs': '; '.join(needs)}


def _equation(effect):
    """Return the output of the effect as a sum of coefficients times columns; empty where it changes the reference motion."""
    columns = [text for group in effect.groups for text in group.text]
    if not columns or effect.warp is not None:
        return ''
    shown = ' + '.join(f'k{n} * ({text})' if ' ' in text else f'k{n} * {text}' for n, text in enumerate(columns[:MAX_SHOWN_COLUMNS], 1))
    return f'output_i += {shown}{f" + ... ({len(columns)} columns)" if len(columns) > MAX_SHOWN_COLUMNS else ""}'
