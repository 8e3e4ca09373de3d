"""
One mind for `calibrate` and `diagnose`: what a recording demands is in the model.

The recording is calibrated with the model that is asked for, then every effect of the catalogue is asked for as a diagnosis asks. What it
names joins the model; what a formula beyond the catalogue does without, what parts of the recording deny, or what is no more than chance
once the standard deviations allow for all that the model misses, does not, and widens the standard deviations instead. So does what would
do nearly as well as a choice, and what stays unexplained: by how much it may move a bias.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from imu_calibration.beyond.inquiry import inquire
from imu_calibration.beyond.unexplained import biases_off
from imu_calibration.calibration.calibrate import conclude, solve_recordings
from imu_calibration.calibration.gathered import Gathered
from imu_calibration.calibration.model_changes import Demand, ModelChanges
from imu_calibration.calibration.options import CalibrationOptions, choose_model
from imu_calibration.calibration.plausibility import one_significant
from imu_calibration.calibration.table_result import TableResult
from imu_calibration.chances import chi2_sf
from imu_calibration.effects.base import Role
from imu_calibration.effects.named_models import BARE
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.prior import make_prior
from imu_calibration.estimation.shrinkage import SURE
from imu_calibration.estimation.solution import Solution
from imu_calibration.reference.table import Table
from imu_calibration.segmentation.window import Window
from imu_calibration.selection.evidence import LEAST_WINDOWS
from imu_calibration.selection.extended_model import extended_solution
from imu_calibration.selection.investigation import Investigation
from imu_calibration.selection.questions import Question
from imu_calibration.selection.search import FAMILY_WISE

Solved = tuple[Solution, Gathered, SensorModel]
"""A solution, what it was made of, and the model whose columns that holds."""


@dataclass(frozen=True, eq=False)
class EvidentSolution:
    """A solution with what its recordings demand of the model, and what was found on the way there."""

    solution: Solution
    """Of the model that was asked for and what is demanded, its covariance widened."""
    gathered: Gathered
    """What was solved."""
    model: SensorModel
    """The model whose columns were gathered."""
    demand: Demand = Demand()
    """What every later solution of the same recordings needs to know."""
    found: Investigation | None = None
    """What was asked and answered; None with too few windows."""


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
    solve = partial(solve_recordings, sources, table, progress=progress, mapper=mapper, names=names)
    found = solve_by_evidence(solve(options, keep_windows=not options.as_asked), table, options, solve_again=solve, asking=asking)
    return EvidentResult(conclude(found.solution, found.gathered, found.model, table=table, options=found.demand.options(options),
                                  provenance=provenance, changes=found.demand.changes), found.found)


def solve_by_evidence(first: Solved, table: Table, options: CalibrationOptions, *, solve_again: Callable[[CalibrationOptions], Solved],
                      asking: Callable | None = None) -> EvidentSolution:
    """
    Return what recordings demand on top of the model that is asked for, solved.

    Parameters
    ----------
    first : tuple
        (Solution, Gathered with the windows to ask, SensorModel) of the model that is asked for.
    table : Table
    options : CalibrationOptions
        What is asked for.
    solve_again : callable
        Returns the same for other options: `added` effects, taken at their `point`.
    asking : callable, optional
        Called with the share of the search that is done.

    """
    solution, gathered, model = first
    parts = windows_to_ask(gathered)
    if not parts:
        return EvidentSolution(*first)
    baseline = baseline_model(options, table, solution.model)
    found, *others = (inquire(windows, table, baseline, progress=asking, bias_processes=options.bias_processes) for windows in parts)
    found, more = _without_faint(found, solution), _named_elsewhere(found, others)
    added, point = (), {}
    while beyond := _beyond((*found.adopted, *more), first[2]):
        point = {name: value for each in (*others, found) for name, value in _point(each).items()}
        added = tuple(question.effect.key for question in beyond)
        solution, gathered, model = solve_again(replace(options, added=added, point=point))
        sure = [question for question in more if not _is_faint(solution, question)]
        if len(sure) < len(more):   # what may be a rival of what the largest names goes first
            more = sure
            continue
        found = _without_faint(found, solution)
        if len(_beyond((*found.adopted, *more), first[2])) == len(beyond):
            break
    else:
        added, point, (solution, gathered, model) = (), {}, first
    demand = Demand(added, point, _changes([found, *others], added), _moves(found), _clipped(found))
    return EvidentSolution(demand.applied(solution), gathered, model, demand, found)


def ask_kept(solved: Solved, table: Table, options: CalibrationOptions, *, known: Demand,
             asking: Callable | None = None) -> EvidentSolution:
    """
    Return what windows demand where columns can be taken no more: what the model holds stays in it, what it lacks is said and widens.

    Parameters
    ----------
    solved : tuple
        As for `solve_by_evidence`, of the model that is asked for with the effects that joined it.
    table, options, asking
        As for `solve_by_evidence`.
    known : Demand
        What was demanded when the columns were taken.

    """
    solution, gathered, model = solved
    parts = windows_to_ask(gathered)
    if not parts:
        return EvidentSolution(*solved, known)
    found = inquire(parts[0], table, baseline_model(options, table, solution.model), progress=asking,
                    bias_processes=options.bias_processes)
    found = _without_faint(found, solution)
    lacking = [] if found.limits else _beyond(found.adopted, model)   # a search that met a limit is the solution itself
    changes = replace(_changes([found], known.added), lacking=tuple(question.name for question in lacking))
    demand = Demand(known.added, known.point, changes, (*known.moves, *_moves(found, lacking)), _clipped(found))
    return EvidentSolution(demand.applied(solution), gathered, model, demand, found)


def windows_to_ask(gathered: Gathered) -> list[list[Window]]:
    """Return the windows of each recording that are enough to ask for effects, those of the largest first."""
    return [windows for windows in (spread.windows for spread in gathered.spreads) if len(windows) >= LEAST_WINDOWS]


def _clipped(found):
    """Return the solution of a search that found a limit: samples that it spoils are out of its windows, and of no others; else None."""
    return extended_solution(found.attempt.space, found.attempt.noise, found.attempt.baseline, chosen=found.adopted,
                             saturations=found.limits) if found.limits else None


def _changes(searches, added):
    """Return what searches, the first above all, and what they added do to the model that was asked for."""
    found, model = searches[0], searches[0].attempt.baseline
    clipping = (model.with_role(limit.sensor, Role.LIMIT).find(limit.sensor, Role.LIMIT).name for limit in found.limits)
    return ModelChanges((*clipping, *(name for _, name in added)), tuple(question.name for question in found.denied), _strange(searches))


def _beyond(named, model):
    """Return the findings that a model lacks."""
    return [question for question in named if question.effect.key not in model.slices]


def _is_faint(solution, question):
    """Return whether an effect is in a solution and does not stand out there."""
    return question.effect.key in solution.model.slices and not stands_out(solution, question)


def _without_faint(found, solution):
    """Return the Investigation without findings that are in a solution and do not stand out there."""
    faint = [question for question in found.named if _is_faint(solution, question)]
    return replace(found, named=[question for question in found.named if question not in faint],
                   denied=[*found.denied, *faint]) if faint else found


def _named_elsewhere(found, others):
    """Return what the search names in other recordings only, those of larger ones first."""
    more = {}
    for question in (question for other in others for question in other.adopted):
        more.setdefault(question.effect.key, question)
    return [question for key, question in more.items() if key not in {known.effect.key for known in found.adopted}]


def stands_out(solution: Solution, question: Question) -> bool:
    """
    Return whether an effect belongs into the model of a solution, with standard deviations that include all allowances.

    Its size is plausible, by the threshold that the verdict uses; it differs from its prior significantly, and so does one coefficient.
    """
    effect, part = question.effect, solution.model.slices[question.sensor, question.name]
    at = np.arange(part.start, part.stop - effect.time_constant)
    if effect.surpasses(solution.values[at]):
        return False
    at = at[~solution.held[at]]
    far = (solution.values - make_prior(solution.model).mean)[at]
    if not one_significant(far, np.sqrt(np.diag(solution.covariance)[at])):
        return False
    sizes, directions = np.linalg.eigh(solution.covariance[np.ix_(at, at)])
    known = sizes > SURE * sizes[-1]   # arms of three sensors add up to nothing by convention
    return bool(chi2_sf(((directions.T @ far)[known]**2 / sizes[known]).sum(), known.sum()) < FAMILY_WISE)


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


def _moves(found, lacking=()):
    """Return (what other choices may move parameters by, weight): what is denied, doubtful, implausible or lacking, a rest, rivals."""
    moves = [(found.attempt.moved_by(found.named, question), 1.0)
             for question in (*found.denied, *found.doubtful, *found.implausible, *lacking)]
    moves += [(moved, 1.0) for moved in biases_off(found.attempt.baseline, found.rests)]
    return (*moves, *((rival.moves, rival.weight) for rival in found.rivals))
