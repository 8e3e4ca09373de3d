"""
Choices of the user by name, the inputs that they select, and the effects.

The module also holds the list of effects and the provenance of a result.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from hashlib import sha256
from os import PathLike
from pathlib import Path
from typing import Any, TypedDict

from imu_calibration.allan.figures import NoiseFigures
from imu_calibration.api.recordings import (
    Stand,
    Topics,
    options_of,
    provenance_of,
)
from imu_calibration.api.resources import config_file
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.core.documents import to_text
from imu_calibration.core.errors import ImuCalibrationError, InputError
from imu_calibration.core.readings import (
    AXES_KEY,
    STATED_KEYS,
    UNIT_KEYS,
    RawReadings,
    combined,
)
from imu_calibration.core.samples import SampleBlock
from imu_calibration.core.settings import override
from imu_calibration.document import files
from imu_calibration.document.calibration import Calibration
from imu_calibration.document.calibration_text import checked_tolerances
from imu_calibration.effects.base import Effect
from imu_calibration.effects.catalogue import CATALOGUE, Catalogue
from imu_calibration.effects.motions import SENSOR_MOTIONS
from imu_calibration.kinematics.rotations import local_gravity
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.window import WindowSettings
from msg_adapters.csv_log import SENSOR_OF, LogOptions


class Choices(TypedDict, total=False):
    """Options of the user by name; each has a default."""

    imu_topic: str | None
    """sensor_msgs/Imu; default /imu/data_raw, otherwise the only one."""
    gyroscope_topic: str | None
    """sensor_msgs/Imu with the rates, where they have a topic of their own."""
    joint_topic: str | None
    """sensor_msgs/JointState; default /joint_states, otherwise the only one."""
    temperature_topic: str | None
    """sensor_msgs/Temperature; default /imu/temperature, otherwise the only one."""
    frame_id: str | None
    """frame_id of the Imu messages; required if a topic has messages of several."""
    exclude: str | None
    """
    Times that are not used, 'A:B,...' in s since the first stamp of the IMU; with several
    recordings 'NAME=A:B,...'.
    """
    columns: Sequence[str]
    """Columns of a text log, 'QUANTITY=NAMES:UNIT', where they are not those of the guess."""
    where: Sequence[str]
    """Conditions 'COLUMN=VALUE': only these rows of a text log are read."""
    accelerometer_model: str | None
    """
    A named model or effect names joined by +; default bias+matrix, and accel_size_effect when the
    rotation shows it.
    """
    gyroscope_model: str | None
    """A named model or effect names joined by +, of the gyroscope; default bias+matrix."""
    reference_model: str | None
    """
    Effects of table and clock joined by +, or 'none'; default table_tilt, and earth_rate unless
    latitude and azimuth are known.
    """
    gravity: float | None
    """
    Local gravity for work by hand or with a robot description, m/s^2; default the standard gravity
    with its uncertainty.
    """
    latitude: float | None
    """Geodetic latitude, degrees, from which gravity follows (WGS 84) where it is not given."""
    height: float | None
    """Height above the ellipsoid, m; default 0."""
    candidates: str | None
    """
    Effects of the package that the search tests, joined by +, or 'none'; default all. Those of
    `catalogue` are always tested.
    """
    model_as_asked: bool
    """Whether the model is used without additions, even where the data support them; default no."""
    tolerances: str | PathLike | Mapping | None
    """
    File or {section: {effect: standard deviation up to which it counts as determined}}; default
    config/tolerances.yaml.
    """
    nominal: str | PathLike | RawReadings | None
    """File or description of the readings: unit, scale and offset per sensor, axes."""
    accelerometer_unit: str | None
    """Unit of the specific force in the recording, such as g or counts:16384/g; default m/s^2."""
    gyroscope_unit: str | None
    """Unit of the angular rate, such as deg/s or counts:16.4/(deg/s); default rad/s."""
    increments: float | None
    """Samples per second of readings that are increments over a sample; default rates."""
    axes: str | None
    """
    Axes of the readings: flu, frd, or the axes of the source that point forward, left and up, such
    as x,-y,-z; default not stated.
    """
    noise: str | PathLike | NoiseFigures | None
    """
    noise.yaml of this IMU: its bias instability, in place of the estimate from the recording; needs
    a table.
    """
    catalogue: Catalogue | str | PathLike | Mapping | None
    """
    Effects added to the package's, or their complete catalogue: a file with `effects`, or {name:
    definition}; default the package's.
    """
    setting: Sequence[str] | Mapping[str, float]
    """How windows are found: 'NAME=NUMBER', ..., or {name: number}."""
    serial: str | None
    """Serial number of the IMU, for the document."""
    operator: str | None
    """Who recorded and calibrated, for the document."""


def topics_of(choices: Mapping[str, Any], readings: RawReadings | None = None) -> Topics:
    """
    Return the topics that were chosen.

    `readings`: description of the readings, by default the one that was chosen.
    """
    return Topics(
        imu=choices.get('imu_topic'),
        joints=choices.get('joint_topic'),
        temperature=choices.get('temperature_topic'),
        frame=choices.get('frame_id'),
        gyroscope=choices.get('gyroscope_topic'),
        log=log_options(readings or readings_of(choices), choices),
    )


def calibration_options(choices: Mapping[str, Any]) -> CalibrationOptions:
    """Return the options of estimation and validation."""
    catalogue = catalogue_of(choices.get('catalogue'))
    if choices.get('candidates') is not None:
        catalogue = catalogue.with_candidates(choices['candidates'])
    tolerances = choices.get('tolerances') or config_file('tolerances.yaml')
    if isinstance(tolerances, Mapping):
        tolerances = checked_tolerances(tolerances, catalogue)
    else:
        tolerances = files.read_tolerances(tolerances, catalogue)
    gravity, gravity_sd = local_gravity(
        choices.get('gravity'), choices.get('latitude'), choices.get('height')
    )
    return CalibrationOptions(
        accelerometer_model=choices.get('accelerometer_model'),
        gyroscope_model=choices.get('gyroscope_model'),
        reference_model=choices.get('reference_model'),
        tolerances=tolerances,
        windows=window_settings(choices.get('setting') or ()),
        nominal=readings_of(choices),
        gravity=gravity,
        catalogue=catalogue,
        noise=noise_of(choices.get('noise')),
        as_asked=bool(choices.get('model_as_asked')),
        gravity_sd=gravity_sd,
    )


def catalogue_of(chosen: Catalogue | str | PathLike | Mapping | None) -> Catalogue:
    """Return the chosen catalogue of effects: given, in a file, or additions to the package's."""
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
            raise InputError(
                f"a setting must be NAME=NUMBER, got '{pair}'; write for example settling=1.0",
                key='setting',
            ) from error
    return override(WindowSettings(), values)


def noise_of(chosen: str | PathLike | NoiseFigures | None) -> NoiseFigures | None:
    """Return the noise figures, read where a file is chosen; None without a choice."""
    if chosen is None or isinstance(chosen, NoiseFigures):
        return chosen
    return files.read_noise(chosen)


def readings_of(choices: Mapping[str, Any]) -> RawReadings | None:
    """
    Return the description of the readings that was chosen; None without a choice.

    It is that of the file or description `nominal`, with the units and axes that are stated.

    Raises
    ------
    InputError
        When a unit does not exist, or a sensor is described by the file and by a unit.

    """
    nominal = choices.get('nominal')
    stated = _stated(choices)
    if nominal is None and not any(stated.values()):
        return None
    # The described readings with the stated units; both for one sensor are refused.
    mapping: Mapping[str, Any] = {}
    if isinstance(nominal, RawReadings):
        mapping = nominal.to_mapping()
    elif nominal is not None:
        mapping = files.read_mapping(nominal, 'description of readings')
    for sensor, key in UNIT_KEYS.items():
        described = any(str(name).startswith(sensor) for name in mapping)
        if described and stated[key]:
            raise InputError(
                f'the unit of the {sensor} must be stated once, got {stated[key]} and the file'
                ' of the readings; remove one',
                key=key,
                code='unit_twice',
            )
    base = RawReadings.from_mapping(mapping, 'the description of readings')
    return combined(base, **stated)


def readings_for(calibration: Calibration, choices: Mapping[str, Any]) -> RawReadings:
    """
    Return the description of readings to which a calibration is applied.

    It is that of the calibration, with the sensors and axes that the choices state. A file or
    description `nominal` replaces it completely.
    """
    described = readings_of(choices)
    if described is None:
        return calibration.readings
    if choices.get('nominal') is not None:
        return described
    return combined(calibration.readings, **_stated(choices))


def _stated(choices: Mapping[str, Any]) -> dict[str, Any]:
    """Return the units and axes that options state, as arguments of `readings.combined`."""
    return {name: choices.get(name) for name in (*STATED_KEYS, AXES_KEY)}


def log_options(readings: RawReadings | None, choices: Mapping[str, Any]) -> LogOptions:
    """
    Return the columns and rows of a text log that were chosen.

    Quantities with a stated unit are read without conversion: the description of the readings
    converts them.
    """
    raw_quantities = []
    for quantity, sensor in SENSOR_OF.items():
        stated = choices.get(UNIT_KEYS[sensor])
        if readings is not None and (stated or not getattr(readings, sensor).is_si):
            raw_quantities.append(quantity)
    columns = choices.get('columns') or ()
    where = choices.get('where') or ()
    return LogOptions(tuple(columns), tuple(where), tuple(raw_quantities))


MAX_SHOWN_COLUMNS = 3
"""Columns of an equation that are shown."""


def effect_rows(added: str | PathLike | None = None) -> list[dict[str, Any]]:
    """
    Return one mapping per effect of the catalogue, with the additional ones of a file.

    Its keys are name, sensor, unit, tolerance, compensation, sentence, equation, and the required
    data and motion.

    Raises
    ------
    InputError
        When the file of additional effects cannot be used.

    """
    return [_row(effect) for effect in catalogue_of(added).effects().values()]


def _row(effect: Effect) -> dict[str, Any]:
    """Return an effect as plain data."""
    units = (effect.unit,) if isinstance(effect.unit, str) else tuple(dict.fromkeys(effect.unit))
    motions = [text for name, text in SENSOR_MOTIONS.items() if name in effect.motion]
    return {
        'effect': effect.name,
        'sensor': effect.sensor,
        'unit': ', '.join(units),
        'tolerance': effect.tolerance,
        'compensation': effect.compensation,
        'text': effect.explanation,
        'equation': _equation(effect),
        'needs': '; '.join([*effect.needs, *motions]),
    }


def _equation(effect: Effect) -> str:
    """
    Return the output of the effect as a sum of coefficients times columns, as text.

    It is empty for an effect that changes the reference motion.
    """
    columns = []
    for group in effect.groups:
        columns += group.text
    if not columns or effect.warp is not None:
        return ''
    terms = []
    for number, text in enumerate(columns[:MAX_SHOWN_COLUMNS], 1):
        terms.append(f'k{number} * ({text})' if ' ' in text else f'k{number} * {text}')
    if len(columns) > MAX_SHOWN_COLUMNS:
        terms.append(f'... ({len(columns)} columns)')
    return f'output_i += {" + ".join(terms)}'


LABELS = ('serial', 'operator')
"""Options that name the IMU and the person."""
STANDS = ('table', 'urdf', 'site')
"""Options with the files of the reference."""
SHORT_HASH_DIGITS = 16
"""Hexadecimal digits of the hashes that earlier versions wrote."""


def provenance_with(
    verb: str,
    recordings: Iterable[str | PathLike | SampleBlock],
    choices: Choices | Mapping[str, Any],
    *,
    stand: Stand | None = None,
) -> dict[str, Any]:
    """
    Return the provenance of a result, without anything that changes from run to run.

    Parameters
    ----------
    verb : str
        Verb or node that computes the result.
    recordings : iterable
        Bags, or samples in memory.
    choices : mapping
        Options, see `Choices`; the file of tolerances is named also if it is the default.
    stand : Stand, optional
        Table or arm.

    """
    used = dict(choices) | options_of(stand)
    used['tolerances'] = used.get('tolerances') or config_file('tolerances.yaml')
    setting = used.get('setting')
    if isinstance(setting, Mapping):
        used['setting'] = [f'{name}={value}' for name, value in setting.items()]
    options = {}
    for name in sorted(used):
        if used[name] and name not in LABELS:
            options[name] = _documented(used[name])
    provenance = {'verb': verb, **provenance_of(recordings, options)}
    for name in LABELS:
        if used.get(name):
            provenance[name] = str(used[name])
    return provenance


def _documented(option: Any) -> Any:
    """
    Return an option as it is written into a document.

    Of a file it is the name and the hash, of a mapping or a table in memory the hash, of a sequence
    its entries; of other data in memory only that they are.
    """
    if isinstance(option, (str, PathLike)):
        if Path(option).is_file():
            return {'name': Path(option).name, 'sha256': files.hash_of(option)}
        return str(option)
    if isinstance(option, (bool, int, float)):
        return option
    if isinstance(option, Iterable) and not isinstance(option, Mapping):
        return list(option)
    entry = {'name': 'in memory'}
    mapping = option.to_mapping() if isinstance(option, Table) else option
    if isinstance(mapping, Mapping):
        entry['sha256'] = sha256(to_text(dict(mapping)).encode()).hexdigest()
    return entry


def made_from(provenance: Mapping[str, Any]) -> set[str]:
    """Return the hashes of the recordings of a provenance, as many digits as all versions write."""
    hashes = set()
    for bag in provenance.get('bags') or ():
        if isinstance(bag, Mapping):
            hashes.add(str(bag.get('sha256'))[:SHORT_HASH_DIGITS])
    return hashes


def require_same_inputs(
    folder: str | PathLike,
    provenance: Callable[[], Mapping[str, Any]],
    name: str = 'calibration.yaml',
    *,
    report: bool = True,
) -> None:
    """
    Refuse to overwrite the result of another verb or of other inputs.

    Parameters
    ----------
    folder : path-like
        Output folder.
    provenance : callable
        Returns the provenance of the new result; called if there is an earlier one.
    name : str
        File of the result.
    report : bool
        Whether the new result has a report.

    Raises
    ------
    InputError
        If the file in the folder differs in verb, recordings, table or robot description, or is no
        such document. Also if there is only a report, which is then that of another verb.

    """
    path = Path(folder) / name
    if not path.exists():
        # A report without a result is that of another verb: the new one must not replace it.
        files.require_new(Path(folder) / files.REPORT, force=not report)
        return
    new = provenance()
    try:
        earlier = files.read_mapping(path, 'document').get('provenance')
    except ImuCalibrationError:
        earlier = None
    if not isinstance(earlier, Mapping):
        earlier = {}
    different = []
    if earlier.get('verb', new.get('verb')) != new.get('verb'):
        different.append('verb')
    if made_from(earlier) != made_from(new):
        different.append('recordings')
    if _stand_options(earlier) != _stand_options(new):
        different.append('reference')
    if different:
        raise InputError(
            f'a result must not replace that of other inputs, {path} differs in'
            f' {" and ".join(different)}; choose another folder, or overwrite it',
            key='force',
            code='other_result',
        )


def _stand_options(provenance: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of a provenance that name the files of the reference."""
    options = provenance.get('options')
    if not isinstance(options, Mapping):
        return {}
    return {name: options[name] for name in STANDS if name in options}
