"""The question that `calibrate` and `diagnose` share: what a recording asks for, without names that a formula does without."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from imu_calibration.beyond.blocks import RestBlocks, rest_blocks
from imu_calibration.beyond.fitting import BlockFits
from imu_calibration.beyond.proposals import Proposal, propose
from imu_calibration.beyond.unexplained import unexplained
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.reference.table import Table
from imu_calibration.segmentation.window import Window
from imu_calibration.selection.investigation import Investigation, investigate
from imu_calibration.selection.questions import Question

CLEAR = 10.0
"""Standard deviations above noise at rest from which moving blocks are asked for a formula."""
NOT_NEEDED = 0.05
"""Share of what a finding takes off the rest that it must still take off beside a formula."""


def inquire(windows: Sequence[Window], table: Table, model: SensorModel, *, progress: Callable | None = None,
            bias_processes: dict | None = None) -> Investigation:
    """
    Ask every effect that a model lacks (`investigate`), and withdraw what a formula does without.

    Parameters
    ----------
    windows, table, model, progress, bias_processes
        As for `investigate`.

    Raises
    ------
    NotObservableError
        As `investigate`.

    """
    return without_superseded(investigate(windows, table, model, progress=progress, bias_processes=bias_processes), table)


def without_superseded(found: Investigation, table: Table) -> Investigation:
    """Return the Investigation without findings that a formula does without; they stay doubtful, and widen what is said of the others."""
    while found.named and (gone := superseded(found, table)):
        names = {question.name for question in gone}
        found = replace(found, named=[question for question in found.named if question not in gone], doubtful=[*found.doubtful, *gone],
                        rivals=[rival for rival in found.rivals if rival.question.name not in names])
    return found


def superseded(found: Investigation, table: Table) -> list[Question]:
    """
    Return the findings that a formula does without: they stood in for the part of it that looks like them.

    A response to the cube of a force is three quarters a response to the force, and the rest of it alone would be told as a formula beside
    a wrong name. So each finding of a sensor that has a formula is left out once, and counts where the windows held out miss it. What
    follows the temperature is left out without a formula too: what settles while the sensor warms up looks like it, so well that hardly a
    rest stays.
    """
    rests = unexplained(found.attempt, found.explained, found.named)
    if not any(question.sensor in rests for question in found.named):
        return []
    blocks = rest_blocks(found.used, table, found.attempt, explained=found.explained)
    gone, proposals = [], {}
    for question in found.named:
        sensor = question.sensor
        if sensor not in rests:
            continue
        own, kept = blocks[sensor], fits_of(found, blocks[sensor], found.named)
        if sensor not in proposals:
            proposals[sensor] = proposal_of(found, own, kept, significant=rests[sensor].significant)
        if proposals[sensor] is None and 'temperature' not in question.effect.needs:
            continue
        left_out = fits_of(found, own, [other for other in found.named if other is not question])
        proposal = proposals[sensor] or propose(own, found.attempt, left_out)
        if proposal is None:
            continue
        formula = _columns(own, proposal, found.attempt.recording.model.temperature_ref_c)
        alone, beside = (left_out.fit(columns).excess - kept.fit(columns).excess for columns in (None, formula))
        if beside < NOT_NEEDED * alone:
            gone.append(question)
    return gone


def fits_of(found: Investigation, blocks: RestBlocks, chosen: Sequence[Question]) -> BlockFits:
    """Return the fits of a choice to the blocks of a sensor."""
    space = found.attempt.space
    return BlockFits(blocks, found.search.used(chosen), prior_sd=space.prior_sd, prior_mean=space.prior_mean)


def proposal_of(found: Investigation, blocks: RestBlocks, fits: BlockFits, *, significant: bool) -> Proposal | None:
    """
    Return a formula for what the findings leave in a sensor, where that is significant or clear within moving windows.

    What changes within moving windows passes for their noise; a formula that takes it away shows that it is none.
    """
    return propose(blocks, found.attempt, fits) if significant or fits.sigma > CLEAR else None


def _columns(blocks, proposal, temperature_ref_c):
    """Return the columns of the formulas over the blocks, shape (b, k, 3)."""
    groups = [group for effect in proposal.effects for group in effect.groups]
    means = [blocks.means(group.columns(blocks.ref, {'temperature_ref_c': temperature_ref_c})) for group in groups]
    return np.stack([np.broadcast_to(mean, (len(mean), 3)) for mean in means], axis=1)
