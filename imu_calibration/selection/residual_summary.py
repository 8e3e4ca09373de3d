"""Analysis beyond the catalogue: regimes and a formula for each sensor with a significant residual."""

from dataclasses import replace

import numpy as np

from imu_calibration.selection.residual_analysis import Examination
from imu_calibration.selection.spectrum import find_tones
from imu_calibration.selection.unexplained import Unexplained


def look_beyond(found: Examination) -> dict[str, Unexplained]:
    """Return sensor -> the unexplained excess with its tones, and with regimes and a proposal where it is significant."""
    tones = find_tones(found, found.table)
    looked = {sensor: replace(rest, tones=tones[sensor]) for sensor, rest in found.rests.items()}
    for sensor, rest in looked.items():
        proposal = found.proposal(sensor)
        if rest.significant or proposal is not None:
            regimes, axes = found.regimes(sensor), rest.axes or found.fits(sensor).axes()
            first = [next((regime for regime in regimes if regime.axis == axis), None) for axis in axes]
            looked[sensor] = replace(rest, regimes=tuple(regime for regime in first if regime is not None), proposal=proposal,
                                     axes=axes if proposal is None else proposal.axes)
        if proposal is not None and not rest.significant:
            looked[sensor] = replace(looked[sensor], significant=True, rms=float(np.hypot.reduce(proposal.sizes)))
    return looked
