"""Analysis beyond the catalogue: regimes and a formula for each sensor with a significant residual."""

from dataclasses import replace

import numpy as np

from imu_calibration.selection.residual_analysis import Examination
from imu_calibration.selection.spectrum import find_tones
from imu_calibration.selection.unexplained import Unexplained


def look_beyond(found: Examination) -> dict[str, Unexplained]:
    """Return sensor -> the unexplained excess with its tones, and with regimes and a proposal where it is significant."""
    tones = find_tones(found, found.table, [proposal for sensor in found.rests if (proposal := found.proposal(sensor)) is not None])
    looked = {sensor: replace(rest, tones=tones[sensor]) for sensor, rest in found.rests.items()}
    for sensor, rest in looked.items():
        proposal = found.proposal(sensor)
        regimes = found.regimes(sensor, formula=found.columns(sensor, proposal))
        first = {regime.axis: regime for regime in reversed(regimes)}
        if rest.significant or proposal is not None or first:
            axes = rest.axes or (found.fits(sensor).axes() if proposal is not None else tuple(first))
            looked[sensor] = replace(rest, regimes=tuple(first[axis] for axis in axes if axis in first), proposal=proposal,
                                     axes=axes if proposal is None else proposal.axes)
        if (proposal is not None or first) and not rest.significant:
            sizes = proposal.sizes if proposal is not None else [regime.size * np.sqrt(regime.inside.mean()) for regime in first.values()]
            looked[sensor] = replace(looked[sensor], significant=True, rms=float(np.hypot.reduce(sizes)))
    return looked
