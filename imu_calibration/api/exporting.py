"""From calibration.yaml to the files of other programs, and back."""

from dataclasses import replace
from os import PathLike
from pathlib import Path

from imu_calibration.api.choices import log_options
from imu_calibration.api.recordings import (
    Stand,
    Topics,
    name_of,
    source_of,
    sources_without,
    temperatures,
)
from imu_calibration.api.references import reference_of
from imu_calibration.core.readings import combined
from imu_calibration.document import files
from imu_calibration.document.calibration import Calibration
from imu_calibration.document.calibration_text import calibration_to_text
from imu_calibration.document.exports.export import Export, export, find_target
from imu_calibration.document.exports.loss import TrialMotion, import_file


def export_calibration(
    calibration: str | PathLike | Calibration,
    to: str,
    *,
    output: str | PathLike | None = None,
    noise: str | PathLike | None = None,
    rate: float | None = None,
    bag: str | PathLike | None = None,
    stand: Stand | None = None,
    topics: Topics = Topics(),
    exclude: str | None = None,
    anyway: bool = False,
    axes: str | None = None,
    force: bool = False,
) -> Export:
    """
    Write a calibration in the format of another program.

    Parameters
    ----------
    calibration : Calibration or path-like
    to : str
        Name of the target, as `all_targets` lists them.
    output : path-like, optional
        The file; None: no file is written.
    noise : path-like, optional
        A noise document.
    rate : float, optional
        Rate at which the target gets the readings, Hz; default that of the noise document.
    bag : path-like, optional
        Recording on which the loss is measured; default `standard_motion`.
    stand : path-like, Table or Arm, optional
        Reference of the true motion of the recording; default its compensated readings.
    topics : Topics
        Of the bag.
    exclude : str, optional
        Times of the bag that are not used, 'A:B,...' in s since its first stamp.
    anyway : bool
        Also the numbers of a sensor whose decision is `harms`; without it they are nominal.
    axes : str, optional
        Axes of the readings of the calibration where it states none, or others, see `Choices`.
    force : bool
        Whether an existing file is replaced.

    Raises
    ------
    ImuCalibrationError
        When a file cannot be read or written, the calibration is not fit for correction, or data
        that the target needs are missing.

    """
    target = find_target(to)
    calibration = files.given_calibration(calibration)
    if axes is not None:
        calibration = replace(calibration, readings=combined(calibration.readings, axes=axes))
    figures = None if noise is None else files.read_noise(noise)
    motion = None
    if bag is not None:
        # Text logs: the calibration converts the quantities with described units, so that the log
        # must not.
        raw_quantities = log_options(calibration.readings, {}).raw
        topics = topics._replace(log=replace(topics.log, raw=raw_quantities))
        motion = _motion(calibration, bag, stand, topics=topics, exclude=exclude)
    exported = export(calibration, target, noise=figures, rate=rate, motion=motion, anyway=anyway)
    if output is not None:
        files.require_new(output, force=force)
        files.write_whole(output, exported.content)
    return exported


def _motion(
    calibration: Calibration,
    bag: str | PathLike,
    stand: Stand | None,
    *,
    topics: Topics,
    exclude: str | None,
) -> TrialMotion:
    """Return the motion of a recording by its reference."""
    reference = reference_of(stand, [bag], topics)
    (source,) = sources_without([source_of(bag, topics, reference.joint_names)], [bag], exclude)
    temperature = temperatures(bag, topics)
    return reference.trial_motion(source, calibration, temperature, name=name_of(bag))


def import_calibration(
    path: str | PathLike,
    source: str,
    *,
    output: str | PathLike | None = None,
    frame_id: str = '',
    force: bool = False,
) -> Calibration:
    """
    Read the file of another program as a calibration.

    Parameters
    ----------
    path : path-like
    source : str
        Name of the program, as in `export_calibration`.
    output : path-like, optional
        calibration.yaml to write; None: no file is written.
    frame_id : str
        Frame of the Imu messages.
    force : bool
        Whether an existing file is replaced.

    Raises
    ------
    ImuCalibrationError
        When it is no such file, or a file cannot be read or written.

    """
    target = find_target(source, read=True)
    content = files.read_bytes(path, f'file of {target.name}')
    calibration = import_file(target, content, Path(path), frame_id=frame_id)
    if output is not None:
        files.require_new(output, force=force)
        files.write_text(output, calibration_to_text(calibration))
    return calibration
