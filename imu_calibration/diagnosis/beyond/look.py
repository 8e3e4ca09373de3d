"""Looking beyond the catalogue: for each sensor with a rest, where it sits and what formula it follows."""

from dataclasses import replace

import numpy as np

from imu_calibration.diagnosis.beyond.blocks import rest_blocks
from imu_calibration.diagnosis.beyond.fitting import BlockFits
from imu_calibration.diagnosis.beyond.proposals import propose
from imu_calibration.diagnosis.beyond.regimes import find_regimes
from imu_calibration.diagnosis.beyond.spectrum import find_tones
from imu_calibration.diagnosis.unexplained import Unexplained
from imu_calibration.effects.base import AXES
from imu_calibration.reference.table import Table
from imu_calibration.selection.investigation import Investigation
from imu_calibration.selection.questions import Question

CLEAR = 10.0
"""Standard deviations above noise at rest from which moving blocks are asked for a formula."""


NOT_NEEDED = 0.05
"""Share of what a finding takes off the rest that it must still take off beside a formula."""


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
    blocks, used = rest_blocks(found.used, table, found.attempt, explained=found.explained), found.attempt.search.used(found.named)
    tones = find_tones(found, table)
    looked = {sensor: replace(rest, tones=tones[sensor]) for sensor, rest in rests.items()}
    for sensor, rest in looked.items():
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


def superseded(found: Investigation, table: Table, rests: dict[str, Unexplained]) -> list[Question]:
    """
    Return the findings that a formula does without: they stood in for the part of it that looks like them.

    A response to the cube of a force is three quarters a response to the force, and the rest of it alone would be told as a formula beside
    a wrong name. So each finding of a sensor that has a formula is left out once, and counts where the windows held out miss it. What
    follows the temperature is left out without a formula too: what settles while the sensor warms up looks like it, so well that hardly a
    rest stays.
    """
    asked = [question for question in found.named
             if question.sensor in rests and (rests[question.sensor].proposal is not None or 'temperature' in question.effect.needs)]
    if not asked:
        return []
    blocks, search = rest_blocks(found.used, table, found.attempt, explained=found.explained), found.attempt.search
    space = found.attempt.space
    gone = []
    for question in asked:
        own = blocks[question.sensor]
        kept, left_out = (BlockFits(own, search.used(choice), prior_sd=space.prior_sd, prior_mean=space.prior_mean)
                          for choice in (found.named, [other for other in found.named if other is not question]))
        proposal = rests[question.sensor].proposal or propose(own, found.attempt, left_out)
        if proposal is None:
            continue
        formula = _columns(own, proposal, found.attempt.recording.model.temperature_ref_c)
        alone, beside = (left_out.fit(columns).excess - kept.fit(columns).excess for columns in (None, formula))
        if beside < NOT_NEEDED * alone:
            gone.append(question)
    return gone


def _columns(blocks, proposal, temperature_ref_c):
    """Return the columns of the formulas over the blocks, shape (b, k, 3)."""
    groups = [group for effect in proposal.effects for group in effect.groups]
    means = [blocks.means(group.columns(blocks.ref, {'temperature_ref_c': temperature_ref_c})) for group in groups]
    return np.stack([np.broadcast_to(mean, (len(mean), 3)) for mean in means], axis=1)
