"""Looking beyond the catalogue: for each sensor with a rest, where it sits and what formula it follows."""

from dataclasses import replace

import numpy as np

from imu_calibration.beyond.blocks import rest_blocks
from imu_calibration.beyond.inquiry import fits_of, proposal_of
from imu_calibration.beyond.regimes import find_regimes
from imu_calibration.beyond.spectrum import find_tones
from imu_calibration.beyond.unexplained import Unexplained
from imu_calibration.effects.base import AXES
from imu_calibration.reference.table import Table
from imu_calibration.selection.investigation import Investigation


def look_beyond(found: Investigation, table: Table, rests: dict[str, Unexplained]) -> dict[str, Unexplained]:
    """
    Return what stays unexplained with its tones, and with regimes and a proposal where a rest is significant.

    Parameters
    ----------
    found : Investigation
    table : Table
    rests : dict
        Sensor -> Unexplained.

    """
    blocks, used = rest_blocks(found.used, table, found.attempt, explained=found.explained), found.search.used(found.named)
    tones = find_tones(found, table)
    looked = {sensor: replace(rest, tones=tones[sensor]) for sensor, rest in rests.items()}
    for sensor, rest in looked.items():
        fits = fits_of(found, blocks[sensor], found.named)
        proposal = proposal_of(found, blocks[sensor], fits, significant=rest.significant)
        if rest.significant or proposal is not None:
            regimes = find_regimes(blocks[sensor], found.attempt, used, joint_names=table.joint_names)
            first = [next((regime for regime in regimes if regime.axis == axis), None) for axis in AXES]
            looked[sensor] = replace(rest, regimes=tuple(regime for regime in first if regime is not None), proposal=proposal,
                                     axes=fits.axes() if proposal is None else proposal.axes)
        if proposal is not None and not rest.significant:
            looked[sensor] = replace(looked[sensor], significant=True, rms=float(np.hypot.reduce(proposal.sizes)))
    return looked
