"""The reference that the user has chosen, and the inputs of a function on recordings."""

from collections.abc import Mapping, Sequence
from os import PathLike
from typing import Any, NamedTuple

from imu_calibration.api.choices import Choices, calibration_options, topics_of
from imu_calibration.api.recordings import (
    RecordingFile,
    Stand,
    Topics,
    source_of,
    sources_without,
    table_of,
)
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.calibration.reference import MotionReference
from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import BlockSource, SampleBlock
from imu_calibration.references.gravity.gravity_reference import GravityReference


def reference_of(
    stand: Stand | None,
    recordings: Sequence[str | PathLike | SampleBlock] = (),
    topics: Topics = Topics(),
    *,
    options: CalibrationOptions = CalibrationOptions(),
) -> MotionReference:
    """
    Return the reference: gravity without a table or an arm.

    Arguments and errors as for `table_of`, with the local gravity of `options`.
    """
    if stand is None:
        return GravityReference()
    # Here, because by hand its import is not needed.
    from imu_calibration.references.turntable.table_reference import TableReference

    table = table_of(
        stand, recordings, topics, gravity=options.gravity, gravity_sd=options.gravity_sd
    )
    return TableReference(table)


class Inputs(NamedTuple):
    """Inputs of a function on recordings."""

    options: CalibrationOptions
    """Options of estimation and validation."""
    reference: MotionReference
    """A table or an arm, or gravity."""
    sources: list[BlockSource]
    """Samples of each recording."""


def inputs_of(
    recordings: Sequence[str | PathLike | SampleBlock],
    stand: Stand | None,
    choices: Mapping[str, Any],
) -> Inputs:
    """
    Return the inputs that the user has chosen; each recording can be opened.

    Parameters
    ----------
    recordings : sequence
        Bags, or samples in memory.
    stand : path-like, Table or Arm, optional
        The reference, see `reference_of`.
    choices : mapping
        See `Choices`.

    Raises
    ------
    InputError
        When a choice does not exist, or a file cannot be used.

    """
    unknown = sorted(set(choices) - set(Choices.__annotations__))
    if unknown:
        raise InputError(
            f'{", ".join(unknown)} cannot be chosen; the choices are'
            f' {", ".join(Choices.__annotations__)}',
            code='choice_unknown',
        )
    options = calibration_options(choices)
    topics = topics_of(choices)
    reference = reference_of(stand, recordings, topics, options=options)
    sources = [source_of(item, topics, reference.joint_names) for item in recordings]
    for source in sources:
        if isinstance(source, RecordingFile):
            source.open().close()
    return Inputs(options, reference, sources_without(sources, recordings, choices.get('exclude')))
