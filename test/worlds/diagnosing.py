"""The diagnosis of windows on a table, with its traces."""

from dataclasses import replace

from imu_calibration.references.turntable.diagnosis_of_windows import build_diagnosis
from imu_calibration.references.turntable.residuals.residual_analysis import inquire
from imu_calibration.references.turntable.window_traces import residual_traces

from worlds.candidates import with_candidates


def diagnose(windows, table, model, *, bias_processes=None, candidates=None):
    """
    Return the Diagnosis of the errors of a model on the windows of one recording, in order.

    Unused ones serve dead reckoning. `candidates` as for `api.diagnose.diagnose`.
    """
    model = with_candidates(model, candidates)
    found = build_diagnosis(inquire(windows, table, model, bias_processes=bias_processes))
    return replace(
        found, traces=residual_traces(windows, table, found.baseline, after=found.solution)
    )
