"""
One mind for `calibrate` and `diagnose`: what a recording demands is in the model.

The recording is calibrated with the model that is asked for, then every effect of the catalogue is asked for as a diagnosis asks. What it
names joins the model; what parts of the recording deny, or what is no more than chance once the standard deviations allow for all that the model
misses, does not, and widens the standard deviations instead, as does what would do nearly as well as a choice.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from imu_calibration.calibration.calibrate import conclude, solve_recordings
from imu_calibration.calibration.model_changes import ModelChanges
from imu_calibration.calibration.options import CalibrationOptions, choose_model
from imu_calibration.calibration.table_result import TableResult
from imu_calibration.effects.base import Role
from imu_calibration.effects.named_models import BARE
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.prior import make_prior
from imu_calibration.estimation.shrinkage import SURE
from imu_calibration.estimation.solution import Solution
from imu_calibration.reference.table import Table
from imu_calibration.selection.extended_model import extended_solution
from imu_calibration.selection.investigation import LEAST_WINDOWS, Investigation, investigate
from imu_calibration.selection.questions import Question
from imu_calibration.selection.search import FAMILY_WISE


@dataclass(frozen=True, eq=False)
class EvidentResult:
    """A calibration with what was found on the way to its model."""

    result: TableResult
    """The calibration."""
    found: Investigation | None
    """What was asked and answered; None with too few windows."""


def calibrate_by_evidence(sources: Sequence[Callable], table: Table, options: CalibrationOptions = CalibrationOptions(), *,
                          provenance: dict | None = None, progress: Callable | None = None, asking: Callable | None = None,
                          mapper: Callable = map, names: Sequence[str] | None = None) -> EvidentResult:
    """
    Calibrate from one or several recordings of the same IMU with what they demand on top of the model that is asked for.

    Parameters
    ----------
    sources, table, options, provenance, progress, mapper, names
        As for `calibrate`.
    asking : callable, optional
        Called with the share of the search that is done.

    Raises
    ------
    InputError
        As `calibrate`.

    """
    first = solve_recordings(sources, table, options, progress=progress, mapper=mapper, names=names,
                             keep_windows=not options.as_asked)
    solution, gathered, model = first
    parts = [windows for windows in (spread.windows for spread in gathered.spreads) if len(windows) >= LEAST_WINDOWS]
    if not parts:
        return EvidentResult(conclude(*first, table=table, options=options, provenance=provenance), None)
    baseline = baseline_model(options, table, solution.model)
    found, *others = (investigate(windows, table, baseline, progress=asking, bias_processes=options.bias_processes) for windows in parts)
    found, more = _without_faint(found, solution), _named_elsewhere(found, others)
    while added := _beyond((*found.adopted, *more), first[2]):
        point = {name: value for each in (*others, found) for name, value in _point(each).items()}
        extended = replace(options, added=tuple(question.effect.key for question in added), point=point)
        solution, gathered, model = solve_recordings(sources, table, extended, progress=progress, mapper=mapper, names=names)
        sure = [question for question in more if not _is_faint(solution, question)]
        if len(sure) < len(more):   # what may be a rival of what the largest names goes first
            more = sure
            continue
        found = _without_faint(found, solution)
        if len(_beyond((*found.adopted, *more), first[2])) == len(added):
            options = extended
            break
    else:
        solution, gathered, model = first
    solution = replace(solution, covariance=solution.covariance + _disagreement(found, solution.param_names))
    if found.limits:   # samples that a limit spoils are out of the windows that were asked, and of no others
        solution = extended_solution(found.attempt.space, found.attempt.noise, found.attempt.baseline, chosen=found.adopted,
                                     saturations=found.limits)
    clipping = [solution.model.find(limit.sensor, Role.LIMIT).name for limit in found.limits]
    changes = ModelChanges((*clipping, *(question.name for question in added)), tuple(question.name for question in found.denied), _strange([found, *others]))
    return EvidentResult(conclude(solution, gathered, model, table=table, options=options, provenance=provenance, changes=changes), found)


def _beyond(named, model):
    """Return the findings that a model lacks."""
    return [question for question in named if question.effect.key not in model.slices]


def _is_faint(solution, question):
    """Return whether an effect is in a solution and does not stand out there."""
    return question.effect.key in solution.model.slices and not stands_out(solution, question)


def _without_faint(found, solution):
    """Return the Investigation without findings that are in a solution and do not stand out there."""
    faint = [question for question in found.named if _is_faint(solution, question)]
    return replace(found, named=[question for question in found.named if question not in faint], denied=[*found.denied, *faint]) if faint else found


def _named_elsewhere(found, others):
    """Return what the search names in other recordings only, those of larger ones first."""
    more = {}
    for question in (question for other in others for question in other.adopted):
        more.setdefault(question.effect.key, question)
    return [question for key, question in more.items() if key not in {known.effect.key for known in found.adopted}]


def stands_out(solution: Solution, question: Question) -> bool:
    """Return whether an effect differs from nothing by more than chance, with standard deviations that allow for what the model misses."""
    effect, part = question.effect, solution.model.slices[question.sensor, question.name]
    at = np.arange(part.start, part.stop - effect.time_constant)
    at = at[~solution.held[at]]
    if not len(at):
        return False
    far = (solution.values - make_prior(solution.model).mean)[at]
    sizes, directions = np.linalg.eigh(solution.covariance[np.ix_(at, at)])
    known = sizes > SURE * sizes[-1]   # arms of three sensors add up to nothing by convention
    return bool(chi2.sf(((directions.T @ far)[known]**2 / sizes[known]).sum(), known.sum()) < FAMILY_WISE)


def baseline_options(options: CalibrationOptions) -> CalibrationOptions:
    """Return the options of the model from which effects are asked: what was not asked for has to prove itself."""
    return replace(options, accelerometer_model=options.accelerometer_model or BARE, reference_model=options.reference_model or 'none')


def baseline_model(options: CalibrationOptions, table: Table, solved: SensorModel) -> SensorModel:
    """
    Return the model from which effects are asked.

    Parameters
    ----------
    options : CalibrationOptions
    table : Table
    solved : SensorModel
        The model of a solution: where its columns were linearised holds for the same effects here.

    """
    model = choose_model(baseline_options(options), table)
    names = {effect.name for effect in model.effects}
    return replace(model, point={name: value for name, value in solved.point.items() if name in names},
                   temperature_ref_c=solved.temperature_ref_c)


def _strange(found):
    """Return effect -> how much of the rest it explains with a size that is known of no instrument, of several investigations."""
    return {question.name: each.explained.share(each.named, question) for each in reversed(found) for question in each.implausible}


def _point(found):
    """Return effect -> values at which its columns are to be taken, of what was found."""
    model = found.attempt.recording.model
    return {question.name: model.point[question.name] for question in found.adopted if question.name in model.point}


def _disagreement(found, names):
    """Return the covariance of what other choices would have moved the parameters by: what is denied, doubtful or implausible, and rivals."""
    moves = [(found.attempt.moved_by(found.named, question), 1.0) for question in (*found.denied, *found.doubtful, *found.implausible)]
    moves += [(rival.moves, rival.weight) for rival in found.rivals]
    total = np.zeros((len(names),) * 2)
    for moved, weight in moves:
        shift = np.array([moved.get(name, 0.0) for name in names])
        total += weight * np.outer(shift, shift)
    return total
