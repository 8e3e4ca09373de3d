"""
A calibration from top to bottom, for any reference: gather, solve, select, prove, document.

A reference gathers and solves (`ModelSource`), and states what it knows of its data
(`Observations`); the search for effects is in `by_evidence`, the proof in `proof`.
"""

from collections.abc import Collection
from dataclasses import replace
from typing import Any

from imu_calibration.calibration.by_evidence import solve_by_evidence
from imu_calibration.calibration.from_solution import Estimate, document
from imu_calibration.calibration.held_out_data import PlainFit
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.calibration.plain_fit import (
    better_plain_fits,
    changes_with,
    plain_entries,
    sensors_with_residual,
    with_fits,
    with_plain_fits,
)
from imu_calibration.calibration.proof import prove
from imu_calibration.calibration.result import CalibrationResult
from imu_calibration.calibration.solved import ModelSource, Solved
from imu_calibration.document.proof_entry import Proof
from imu_calibration.estimation.solution import tolerances_of, with_weak_replaced


def calibrate_by_evidence(
    source: ModelSource[Estimate],
    options: CalibrationOptions = CalibrationOptions(),
    *,
    provenance: dict | None = None,
) -> CalibrationResult[Estimate]:
    """
    Calibrate from recordings of one IMU with any reference.

    Effects that they support are added to the requested model.

    Parameters
    ----------
    source : ModelSource
        `TableRecordings`, or `PoseRecording` by hand.
    options : CalibrationOptions
        Of the requested model.
    provenance : dict, optional
        Names of recordings, hashes and options for the document.

    Raises
    ------
    InputError
        When a recording cannot be used, or a requested effect needs a table that is not there.
    NotObservableError
        When no parameter is determined.

    """
    # Gather and solve; select the effects that the data support, and solve again with them.
    selected = solve_by_evidence(source, options)

    # Prove on held-out data, and document.
    return conclude(selected, selected.extension.options(options), provenance=provenance)


def conclude(
    solved: Solved[Estimate],
    options: CalibrationOptions = CalibrationOptions(),
    *,
    provenance: dict[str, Any] | None = None,
    under_test: Collection[str] = (),
    is_judged: bool = True,
) -> CalibrationResult[Estimate]:
    """
    Judge a solution on held-out data, state what it does not determine, and document it.

    Parameters
    ----------
    solved : Solved
    options : CalibrationOptions
        Of the model that was solved.
    provenance : dict, optional
        Names of recordings, hashes and options for the document.
    under_test : collection of str
        Sensors of which the effects have to predict better than plain least squares, besides those
        with a residual that is not noise.
    is_judged : bool
        False where only the status of the parameters is wanted: no data are held out, and the
        document has no proof.

    Raises
    ------
    InputError
        When the readings are clearly in another unit.

    """
    data = solved.data
    changes = solved.extension.changes
    tolerances = tolerances_of(solved.solution.model, options.tolerances)

    # Findings that follow from the solution; errors of the reference enter its covariance.
    gathered = replace(data.gathered, findings=data.findings(solved.solution))
    solution = with_weak_replaced(data.with_reference_errors(solved.solution), tolerances)

    # Effects that predict held-out data worse than bias and matrix alone are not applied.
    fits: tuple[PlainFit, ...] = ()
    proof: Proof = {}
    if is_judged:
        held_out = data.held_out(solution)
        concerned = sensors_with_residual(changes, solution.model).union(under_test)
        fits = better_plain_fits(held_out, under_test=concerned, as_asked=options.as_asked)
        proof = prove(with_fits(held_out, fits))
    applied = with_plain_fits(solution, fits)

    # Parameters that are not determined, each with the motion or knowledge that determines it.
    statistics = data.statistics(applied).to_mapping()
    needs = data.needs(applied, tolerances, quality={**statistics, **changes.to_mapping()})

    calibration = document(
        applied,
        tolerances,
        gathered,
        gravity=data.gravity,
        gauge=data.gauge(applied),
        undetermined=needs.undetermined,
        statistics=statistics | plain_entries(fits),
        provenance=provenance,
        proof=proof,
        changes=changes_with(changes, fits),
        uncorrected=data.uncorrected(applied),
        tested=data.tested,
        absent=data.absent,
        readings=options.nominal,
    )
    return CalibrationResult(
        calibration=calibration,
        data=data,
        gathered=gathered,
        tolerances=tolerances,
        needed=needs.motions,
        options=options,
        solution=solution,
        applied=applied,
        fits=fits,
        search=solved.search,
    )
