"""
Model selection by `calibrate` and `diagnose` in common.

Effects that the data support are added to the model.

The recording is calibrated with the requested model, then every effect of the catalogue is tested
as in a diagnosis. Significant effects are added to the model. An effect is rejected when a formula
beyond the catalogue makes it unnecessary, when the estimates from parts of the recording differ, or
when it is not significant with the widened standard deviations; it then widens the standard
deviations instead. So do alternatives to a chosen effect that fit nearly as well, and the
unexplained residual: by the change of a bias that it may cause.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from imu_calibration.calibration.from_solution import Estimate, ModelChanges, ModelExtension
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.calibration.solved import ModelSource, Solved
from imu_calibration.core.distributions import chi2_sf
from imu_calibration.document.calibration import one_significant
from imu_calibration.effects.base import Role
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.prior import make_prior
from imu_calibration.estimation.solution import CONVENTION_SHARE, Solution
from imu_calibration.selection.questions import Question
from imu_calibration.selection.search import FAMILY_WISE
from imu_calibration.selection.selected_effects import SelectedEffects, SelectionSettings


def solve_by_evidence(
    source: ModelSource[Estimate], options: CalibrationOptions = CalibrationOptions()
) -> Solved[Estimate]:
    """
    Return the solution of the requested model with the effects that the recordings support.

    Parameters
    ----------
    source : ModelSource
    options : CalibrationOptions
        Options of the requested model.

    """
    # Solve the requested model, and search in each recording with enough data.
    first = source.solved(options)
    searches = list(first.data.searches(first.solution, options))
    if not searches:
        return first

    # Add the effects that remain significant in the common solution.
    solved, searches = _with_significant(source, options, first, searches)

    # The other choices of effects, and a limit of a sensor, change the covariance.
    main_search = searches[0]
    extension = replace(
        solved.extension,
        changes=_changes(searches, solved.extension.added),
        moves=_moves(main_search),
        clipped=main_search.clipped_solution(),
    )
    solution = extension.applied(solved.solution)
    return replace(solved, solution=solution, extension=extension, search=main_search)


def _with_significant(
    source: ModelSource[Estimate],
    options: CalibrationOptions,
    first: Solved[Estimate],
    searches: Sequence[SelectedEffects],
) -> tuple[Solved[Estimate], list[SelectedEffects]]:
    """
    Return (solution with the effects that are significant in it, searches without other findings).

    Backward elimination: solve with all effects, remove the insignificant ones, solve again.

    Parameters
    ----------
    source : ModelSource
    options : CalibrationOptions
        Options of the requested model.
    first : Solved
        Of the requested model.
    searches : sequence of SelectedEffects
        Of each recording, the largest one first.

    """
    main_search, *other_searches = searches
    other_findings = _findings_of_others_only(main_search, other_searches)
    while True:
        # An effect of the requested model is judged with the added effects in the solution: the
        # misfit of a missing delay or encoder zero widens every standard deviation.
        added = _missing_effects((*main_search.adopted, *other_findings), first.model)
        solved = _solved_with(source, options, first, added, (*other_searches, main_search))

        # Findings of other recordings first: they may be collinear with those of the largest one,
        # which can become significant without them.
        significant = [
            finding
            for finding in other_findings
            if not _is_insignificant(solved.solution, finding, main_search.settings)
        ]
        if len(significant) < len(other_findings):
            other_findings = significant
            continue

        main_search = _without_insignificant(main_search, solved.solution, first.model)
        remaining = _missing_effects((*main_search.adopted, *other_findings), first.model)
        if len(remaining) == len(added):  # all added effects are significant
            return solved, [main_search, *other_searches]


def _solved_with(
    source: ModelSource[Estimate],
    options: CalibrationOptions,
    first: Solved[Estimate],
    added: Sequence[Question],
    searches: Sequence[SelectedEffects],
) -> Solved[Estimate]:
    """
    Return the solution with added effects, linearised at their estimates.

    The estimates of the last search have priority. `first`: the solution without these effects. An
    effect is added together with its effect of lower order, where the model lacks that.
    """
    if not added:
        return first
    point: dict[str, np.ndarray] = {}
    for search in searches:
        point |= search.point_of_adopted
    keys = [question.effect.key for question in added]
    for question in added:
        lower_key = (question.sensor, question.effect.lower_order)
        if question.effect.lower_order and lower_key not in (*keys, *first.model.slices):
            keys.append(lower_key)
    extension = ModelExtension(tuple(keys), point)
    return replace(source.solved(extension.options(options)), extension=extension)


def search_again(
    solved: Solved[Estimate], options: CalibrationOptions, *, known: ModelExtension
) -> Solved[Estimate]:
    """
    Return a solution with the result of a new search, where no effect can be added to the model.

    The columns of further effects cannot be computed from what is stored. Supported effects that
    the model lacks are therefore reported, and widen the covariance.

    Parameters
    ----------
    solved : Solved
        Of the requested model with the added effects.
    options : CalibrationOptions
        As for `solve_by_evidence`.
    known : ModelExtension
        The effects that were supported when the columns were computed.

    """
    solution = solved.solution
    model = solved.model
    search = next(solved.data.searches(solution, options), None)
    if search is None:
        return replace(solved, extension=known)
    search = _without_insignificant(search, solution, model)

    # The columns of effects that the model lacks are not stored. After a limit was found, the
    # solution is that of the search, which has them.
    missing = [] if search.limits else _missing_effects(search.adopted, model)
    changes = _changes([search], known.added)
    extension = ModelExtension(
        added=known.added,
        point=known.point,
        changes=replace(changes, lacking=tuple(question.name for question in missing)),
        moves=(*known.moves, *_moves(search, missing)),
        clipped=search.clipped_solution(),
    )
    return replace(solved, solution=extension.applied(solution), extension=extension, search=search)


def _changes(searches: Sequence[SelectedEffects], added: Sequence[tuple[str, str]]) -> ModelChanges:
    """
    Return the names of effects and the residuals of searches, for the document.

    `added`: (sensor, effect) in addition to the requested model. The first search has priority.
    """
    first = searches[0]
    added_names = []
    for limit in first.limits:
        with_limit = first.baseline_model.with_role(limit.sensor, Role.LIMIT)
        added_names.append(with_limit.effect_of(limit.sensor, Role.LIMIT).name)
    added_names += [name for _, name in added]

    unexplained = {}
    for search in reversed(searches):
        for sensor, residual in search.unexplained_rests().items():
            if residual.significant:
                unexplained[sensor] = residual.entry
    # The first recording with a change of parameters.
    change_times = [search.changed_at for search in searches if search.changed_at is not None]
    return ModelChanges(
        added=tuple(added_names),
        unstable=tuple(question.name for question in first.unstable),
        implausible=_implausible_shares(searches),
        unexplained=unexplained,
        stamp_jitter=dict(first.jitter_entry),
        changed_at=change_times[0] if change_times else None,
    )


def _missing_effects(findings: Iterable[Question], model: SensorModel) -> list[Question]:
    """Return those of the findings whose effects a model lacks."""
    return [question for question in findings if question.effect.key not in model.slices]


def _is_insignificant(solution: Solution, question: Question, settings: SelectionSettings) -> bool:
    """Return whether an effect is in a solution but not significant."""
    if question.effect.key not in solution.model.slices:
        return False
    return not stands_out(solution, question, joint_test=settings.joint_test)


def _without_insignificant(
    search: SelectedEffects, solution: Solution, requested: SensorModel
) -> SelectedEffects:
    """
    Return the search without findings that are in a solution but not significant.

    They are then unstable. Effects of the requested model are judged by some references only.
    """
    significant = []
    insignificant = []
    for question in search.named:
        is_requested = question.effect.key in requested.slices
        is_judged = search.settings.judge_requested or not is_requested
        if is_judged and _is_insignificant(solution, question, search.settings):
            insignificant.append(question)
        else:
            significant.append(question)
    if not insignificant:
        return search
    return replace(search, named=significant, unstable=[*search.unstable, *insignificant])


def _findings_of_others_only(
    main_search: SelectedEffects, other_searches: Sequence[SelectedEffects]
) -> list[Question]:
    """
    Return the adopted effects of other recordings that the search in the largest one lacks.

    Each has one finding, that of the largest recording that has it.
    """
    known = {question.effect.key for question in main_search.adopted}
    findings = {}  # key of the effect -> finding
    for search in other_searches:
        for question in search.adopted:
            if question.effect.key not in known:
                findings.setdefault(question.effect.key, question)
    return list(findings.values())


def stands_out(solution: Solution, question: Question, *, joint_test: bool = True) -> bool:
    """
    Return whether an effect belongs into the model of a solution.

    Its size is plausible, one amplitude is significant, and with `joint_test` so are all together.
    The covariance C of the amplitudes a includes all allowances. With the prior means m::

        chi^2 = (a - m)^T C^+ (a - m),   degrees of freedom: rank of C

    """
    effect = question.effect
    first = solution.model.slices[effect.key].start
    amplitudes = np.arange(first, first + effect.n_amplitudes)

    # The threshold that the verdict of a diagnosis uses.
    if effect.surpasses(solution.values[amplitudes]):
        return False

    estimated = amplitudes[~solution.held[amplitudes]]
    prior_mean = make_prior(solution.model).mean
    change = solution.values[estimated] - prior_mean[estimated]
    covariance = solution.covariance[np.ix_(estimated, estimated)]
    if not one_significant(change, np.sqrt(np.diag(covariance))):
        return False
    if not joint_test:
        return True

    # The lever arms of three sensors sum to zero by convention: C may be singular. The sum is over
    # its eigenvectors with a variance.
    variances, eigenvectors = np.linalg.eigh(covariance)
    in_rank = variances > CONVENTION_SHARE * variances[-1]
    components = eigenvectors.T @ change
    chi_squared = (components[in_rank] ** 2 / variances[in_rank]).sum()
    return bool(chi2_sf(chi_squared, in_rank.sum()) < FAMILY_WISE)


def _implausible_shares(searches: Sequence[SelectedEffects]) -> dict[str, float]:
    """
    Return implausible effect -> share of the excess variance that it explains.

    The first of several searches has priority.
    """
    shares = {}
    for search in reversed(searches):
        for question in search.implausible:
            shares[question.name] = search.explained.share(search.named, question)
    return shares


def _moves(
    search: SelectedEffects, missing: Sequence[Question] = ()
) -> tuple[tuple[Mapping[str, float], float], ...]:
    """
    Return (parameter -> its change by another choice of effects, weight of the choice), of each.

    Another choice has an unstable, rejected, implausible or missing effect in addition to the
    findings, or is one of `further_moves`.
    """
    moves = []
    for question in (*search.unstable, *search.rejected, *search.implausible, *missing):
        change = search.search.moved_by(search.named, question, search.param_names)
        moves.append((change, 1.0))  # each choice has the full weight
    return (*moves, *search.further_moves)
