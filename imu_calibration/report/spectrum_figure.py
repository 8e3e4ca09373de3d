"""Spectra of the unexplained residual with its significant tones."""

import numpy as np

from imu_calibration.report.figures import AFTER, GREY, INK, draw
from imu_calibration.selection.spectrum import CLEAR
from imu_calibration.selection.unexplained import Unexplained


def draw_tones(sensor: str, rest: Unexplained) -> str:
    """Return the spectra with significant tones, as SVG; empty if there are none."""
    if not rest.tones:
        return ''
    label = f'Spectrum of the unexplained residual of the {sensor}'
    return draw(f'tones-{sensor}', (8.6, 0.6 + 2.1 * len(rest.tones)), _Spectra(rest.tones), label=label)


class _Spectra:
    """One panel for each tone: the power of its axis over that around it."""

    def __init__(self, tones):
        self.tones = tones

    def __call__(self, figure):
        for axes, tone in zip(np.atleast_1d(figure.subplots(len(self.tones), 1)), self.tones):
            axes.plot(tone.frequencies, tone.power, color=AFTER, lw=0.9)
            axes.axhline(CLEAR, color=GREY, lw=0.6)
            axes.axvline(tone.frequency, color=INK, lw=0.8, ls=':')
            axes.set_yscale('log')
            axes.set_ylabel(f'{tone.sensor} {tone.axis}: power / around')
            axes.set_xlabel('frequency, Hz' if tone.joint is None else f'cycles per turn of {tone.joint}')
