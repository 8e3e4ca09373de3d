"""Looking beyond the catalogue: for each sensor with a rest, where it sits and what formula it follows."""

from dataclasses import replace

import numpy as np

from imu_calibration.diagnosis.beyond.blocks import rest_blocks
from imu_calibration.diagnosis.beyond.fitting import BlockFits
from imu_calibration.diagnosis.beyond.proposals import propose
from imu_calibration.diagnosis.beyond.regimes import find_regimes
from imu_calibration.diagnosis.unexplained import Unexplained
from imu_calibration.effects.base import AXES
from imu_calibration.reference.table import Table
from imu_calibration.selection.investigation import Investigation

CLEAR = 10.0
"""Standard deviations above noise at rest from which moving blocks are asked for a formula."""


def look_beyond(found: Investigation, table: Table, rests: dict[str, Unexplained]) -> dict[str, Unexplained]:
    """
    Return what stays unexplained with regimes and a proposal where a rest is significant.

    Parameters
    ----------
    found : Investigation
    table : Table
    rests : dict
        Sensor -> Unexplained.

    """
    blocks, used = rest_blocks(found.used, table, found.attempt, explained=found.explained), found.attempt.search.used(found.named)
    looked = dict(rests)
    for sensor, rest in rests.items():
        fits = BlockFits(blocks[sensor], used, prior_sd=found.attempt.space.prior_sd, prior_mean=found.attempt.space.prior_mean)
        # What changes within moving windows passes for their noise; a formula that takes it away shows that it is none.
        proposal = propose(blocks[sensor], found.attempt, fits) if rest.significant or fits.sigma > CLEAR else None
        if rest.significant or proposal is not None:
            regimes = find_regimes(blocks[sensor], found.attempt, used, joint_names=table.joint_names)
            first = [next((regime for regime in regimes if regime.axis == axis), None) for axis in AXES]
            looked[sensor] = replace(rest, regimes=tuple(regime for regime in first if regime is not None), proposal=proposal,
                                     axes=fits.axes() if proposal is None else proposal.axes)
        if proposal is not None and not rest.significant:
            looked[sensor] = replace(looked[sensor], significant=True, rms=float(np.hypot.reduce(proposal.sizes)))
    return looked
