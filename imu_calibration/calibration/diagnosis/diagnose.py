"""A diagnosis from top to bottom, for any reference: calibrate, identify, add formulas, trace."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from imu_calibration.calibration.calibrate import calibrate_by_evidence, conclude
from imu_calibration.calibration.diagnosis.diagnosis_result import Diagnosis
from imu_calibration.calibration.diagnosis.diagnosis_workflow import (
    DiagnosisResult,
    is_transferable,
    proposed_effects,
)
from imu_calibration.calibration.from_solution import ModelExtension
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.calibration.plain_fit import CLEARLY_BETTER
from imu_calibration.calibration.reference import MotionReference
from imu_calibration.calibration.result import CalibrationResult
from imu_calibration.calibration.solved import ModelSource
from imu_calibration.core.samples import BlockSource
from imu_calibration.document.calibration import Calibration
from imu_calibration.document.decision import HARM
from imu_calibration.effects.base import SECTIONS, Effect, Role
from imu_calibration.selection.unexplained import biases_off


def diagnose_recording(
    source: BlockSource,
    reference: MotionReference,
    options: CalibrationOptions = CalibrationOptions(),
    *,
    provenance: dict[str, Any] | None = None,
) -> DiagnosisResult:
    """
    Calibrate a recording, identify the errors of the model and their causes, and extend it.

    Parameters
    ----------
    source : BlockSource
        The recording.
    reference : MotionReference
    options : CalibrationOptions
        The initial model; default bias and matrix, so that every other effect is tested.
    provenance : dict, optional
        Names, hashes and options for the document.

    Raises
    ------
    InputError
        When the recording cannot be used.
    NotObservableError
        When no parameter is determined, or the data do not suffice for a search.

    """
    # Calibrate with the effects of the catalogue that the data support.
    recording = reference.stored(source, options)
    result = calibrate_by_evidence(
        recording, replace(options, as_asked=False), provenance=provenance
    )
    if result.search is None:
        raise reference.too_few(result)

    # Causes, gains and mates of these effects, and the residual that none explains.
    diagnosis = reference.identify(result)

    # The formulas of the residual join the model.
    formulas = _formula_models(recording, ProposedExtension(result, diagnosis, options, provenance))

    # Measured against simulated, before and after.
    traces = reference.traces(
        recording, diagnosis.baseline, formulas.proposed or diagnosis.solution
    )
    return DiagnosisResult(
        diagnosis=replace(diagnosis, traces=traces),
        calibration=result.calibration,
        tolerances=result.tolerances,
        needed=result.needed,
        observations=result.observations,
        proposed=formulas.proposed,
        transferable=formulas.transferable,
        unhelpful=formulas.unhelpful,
    )


@dataclass(frozen=True, eq=False)
class _FormulaModels:
    """Calibrations of the model with formulas of the residual."""

    proposed: Calibration | None
    """Calibration with all formulas; None without a formula."""
    transferable: Calibration | None
    """Calibration with the formulas that help and that compensation of another recording undoes."""
    unhelpful: tuple[str, ...]
    """Formulas that compensation could undo, but which do not help."""


def _formula_models(source: ModelSource[Any], extension: 'ProposedExtension') -> _FormulaModels:
    """Return the calibrations with the formulas of a diagnosis."""
    # All formulas describe this recording.
    effects = proposed_effects(extension.diagnosis)
    proposed = _with_proposals(source, extension, effects)

    # For other recordings: formulas that compensation can undo, and of these the ones that help.
    transferable = proposed
    transferable_effects = [effect for effect in effects if is_transferable(effect)]
    if len(transferable_effects) < len(effects):
        transferable = _with_proposals(source, extension, transferable_effects)
    helpful = helpful_formulas(transferable_effects, transferable, extension.result.calibration)
    if len(helpful) < len(transferable_effects):
        transferable = _with_proposals(source, extension, helpful)
    unhelpful = [effect for effect in transferable_effects if effect not in helpful]
    return _FormulaModels(
        proposed, transferable, tuple(effect.groups[0].text[0] for effect in unhelpful)
    )


def helpful_formulas(
    effects: Sequence[Effect], extended: Calibration | None, calibration: Calibration
) -> list[Effect]:
    """
    Return the formulas with which the error of their sensor on held-out windows is smaller.

    The error has to be clearly smaller in total, and not larger in a regime of motion. The solution
    with formulas must also predict better than plain least squares.

    Parameters
    ----------
    effects : sequence of Effect
        Formulas of the extended model.
    extended, calibration : Calibration
        With the formulas, and without them; None without formulas.

    """
    helpful: list[Effect] = []
    if extended is None:
        return helpful
    for effect in effects:
        before = calibration.proof.get(effect.sensor)
        after = extended.proof.get(effect.sensor)
        if before is None or after is None:
            continue
        # Plain least squares predicts better: the formula is in no applied model.
        if effect.sensor in extended.statistics.get('least_squares', ()):
            continue
        if after.after > CLEARLY_BETTER * before.after:
            continue
        # A formula of one motion may harm in another one.
        harmed_regimes = [
            name
            for name, errors in after.regimes.items()
            if name in before.regimes and errors.after > HARM * before.regimes[name].after
        ]
        if not harmed_regimes:
            helpful.append(effect)
    return helpful


@dataclass(frozen=True, eq=False)
class ProposedExtension:
    """A diagnosed calibration whose model formulas of the residual extend."""

    result: CalibrationResult[Any]
    """The calibration without formulas."""
    diagnosis: Diagnosis
    """Its unexplained residuals, which the biases may contain."""
    options: CalibrationOptions
    """Options of the requested model."""
    provenance: dict[str, Any] | None = None
    """Names, hashes and options for the document."""


def _with_proposals(
    source: ModelSource[Any], extension: ProposedExtension, effects: Sequence[Effect]
) -> Calibration | None:
    """
    Return the calibration of the extended model with the formulas `effects`; None without any.
    """
    if not effects:
        return None

    # Exactly the effects of the calibration and the formulas, without a further search.
    model = extension.result.calibration.model
    names: dict[str, list[str]] = {section: [] for section in SECTIONS}
    for effect in (*model.effects, *effects):
        if effect.role is not Role.LIMIT:
            names[effect.sensor].append(effect.name)
    options = replace(
        extension.options,
        accelerometer_model='+'.join(names['accelerometer']),
        gyroscope_model='+'.join(names['gyroscope']),
        reference_model='+'.join(names['reference']) or 'none',
        catalogue=model.catalogue.with_effects(*effects),
        as_asked=True,
    )
    solved = source.solved(options)

    # A formula determines changes of the output, not its zero: the biases of the affected axes may
    # still contain the residual, and keep this uncertainty.
    bias_changes = biases_off(model, extension.diagnosis.unexplained)
    widened = ModelExtension(moves=tuple((change, 1.0) for change in bias_changes))
    return conclude(
        replace(solved, solution=widened.applied(solved.solution)),
        options,
        provenance=extension.provenance,
        under_test={effect.sensor for effect in effects},
    ).calibration
