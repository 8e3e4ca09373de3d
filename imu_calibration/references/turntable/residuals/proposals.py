"""Formulas for the unexplained residual of a sensor, tested on held-out windows."""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from imu_calibration.core.units import for_people, with_sd
from imu_calibration.effects.base import AXES, PREFIXES, SENSORS, Effect
from imu_calibration.effects.catalogue import term
from imu_calibration.effects.motions import ALL_MOTIONS
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.references.turntable.residuals.formulas import (
    Column,
    Formula,
    FormulaChoice,
    FormulaSearch,
    grammar,
)
from imu_calibration.references.turntable.residuals.residual_blocks import (
    BlockFit,
    BlockFits,
    BlockMeans,
    share_interval,
    share_removed,
)
from imu_calibration.references.turntable.selection.linearised_problem import LinearisedProblem
from imu_calibration.selection.explained_share import MIN_SMOOTH_SHARE

MIN_FORMULA_SHARE = 0.6
"""Share of the excess of held-out windows that a formula must remove."""
WORTH_A_SECOND = 0.1
"""Share of the excess that a second formula must remove in addition."""
MOST_TERMS = 2
"""Largest number of terms of a proposal."""
ONE_SHAPE = 0.9
"""
Share of the squared amplitudes of a formula, all axes, that one combination of its columns must
have to replace all of them.
"""
OTHER_SENSOR = 3.0
"""
Standard deviations by which a cause of the table may differ from the estimate of the other sensor.
"""
SHOWN_ALIKE = 3
"""Largest number of reported formulas of a class."""
CONCERNED_SDS = 4.0
"""Standard deviations from which an axis counts as concerned."""


@dataclass(frozen=True, eq=False)
class Proposal:
    """Formulas that explain most of a sensor's residual outside the catalogue."""

    sensor: str
    """'accelerometer' or 'gyroscope'."""
    effects: tuple[Effect, ...]
    """The formulas as terms: each a text, a unit and a tolerance."""
    values: tuple[np.ndarray, ...]
    """Amplitudes of each formula on the three axes, SI."""
    sds: tuple[np.ndarray, ...]
    """Standard deviations of the amplitudes, larger by the misfit."""
    family: frozenset[str]
    """Quantities in the formulas."""
    axes: tuple[str, ...]
    """Axes of the sensor on which the formulas are significant."""
    share: float
    """Share of the excess of held-out windows, in squares, that the formulas remove."""
    ci95: tuple[float, float]
    """95 % interval of the share."""
    reduction: float
    """Share of the rms beyond noise that they remove there."""
    p_value: float
    """Probability of the first formula by noise, times the number of formulas."""
    alike: tuple[str, ...]
    """Formulas that are not separable from the first in this recording."""
    nearest: tuple[str, float] | None
    """Effect of the catalogue that fits best, and the share that it removes."""
    motion: str
    """A motion that would confirm it."""
    sizes: tuple[float, ...] = field(default=())
    """Rms of each formula's contribution over the recording, m/s^2 or rad/s."""

    @property
    def columns(self) -> tuple[str, ...]:
        """The formulas as texts."""
        return tuple(_text_of(effect) for effect in self.effects)

    @property
    def sentence(self) -> str:
        """Description of the proposal with the motion that confirms it."""
        return self.relation + (f'; to confirm it: {self.motion}' if self.motion else '')

    @property
    def relation(self) -> str:
        """Description of the proposal."""
        formulas = []
        for column, effect, value, sd in zip(self.columns, self.effects, self.values, self.sds):
            formulas.append(f'{column}, {_size(effect, value, sd)}')
        text = (
            f'{100 * self.share:.0f} % of it ({100 * self.ci95[0]:.0f} to {100 * self.ci95[1]:.0f}'
            f' %, on windows held out) follows {" and ".join(formulas)}'
        )
        if self.nearest is not None:
            text += (
                f'; it is not in the catalogue: {self.nearest[0]}, the closest effect, '
                f'would remove {100 * max(self.nearest[1], 0.0):.0f} %'
            )
            if self.nearest[1] > MIN_FORMULA_SHARE:
                text += ' here, but the remaining axes or sensor contradict it'
        if self.alike:
            text += f'; collinear in this recording: {" or ".join(self.alike)}'
        return text

    def to_mapping(self) -> dict:
        """Return the proposal as plain data."""
        terms = []
        for effect, value, sd, size in zip(self.effects, self.values, self.sds, self.sizes):
            terms.append(
                {
                    'name': effect.name,
                    'definition': effect.definition,
                    'value': value.tolist(),
                    'sd': sd.tolist(),
                    'rms': size,
                }
            )
        return {
            'terms': terms,
            'axes': list(self.axes),
            'share_of_unexplained': self.share,
            'ci95': list(self.ci95),
            'rms_reduction': self.reduction,
            'p_value': self.p_value,
            'indistinguishable_from': list(self.alike),
            'nearest_of_the_catalogue': (
                None
                if self.nearest is None
                else {'effect': self.nearest[0], 'share': self.nearest[1]}
            ),
            'confirming_motion': self.motion,
            'sentence': self.sentence,
        }


def with_formulas(
    model: SensorModel, values: np.ndarray, proposals: Iterable[Proposal]
) -> tuple[SensorModel, np.ndarray]:
    """Return a model and its parameters with the formulas of some proposals at their amplitudes."""
    for proposal in proposals:
        for effect, size in zip(proposal.effects, proposal.values):
            known = replace(model, catalogue=model.catalogue.with_effects(effect))
            model, values = known.with_sized_effect(values, effect.sensor, effect.name, size=size)
    return model, values


def find_formulas(blocks: BlockMeans, problem: LinearisedProblem) -> list[FormulaChoice]:
    """
    Return the likeliest formulas for a sensor's residual, at most `MOST_TERMS`.

    Each one is significant in addition to the earlier ones. They are chosen on the selection
    windows, with all plausible contributions of the catalogue projected out.
    """
    search = FormulaSearch(
        blocks,
        _grammar(blocks),
        _plausible_sizes(blocks.sensor, problem),
        reference_temperature=problem.recording.model.temperature_ref_c,
    )
    choices: list[FormulaChoice] = []
    while len(choices) < MOST_TERMS:
        if choices:
            search.project_out(choices[-1])
        choice = search.best()
        if choice is None:
            break
        choices.append(choice)
    return choices


def propose(
    blocks: BlockMeans,
    problem: LinearisedProblem,
    fits: BlockFits,
    *,
    formulas: Sequence[FormulaChoice],
) -> Proposal | None:
    """
    Return a Proposal for the residual of a sensor with the model of some fits.

    None where no formula removes most of the excess. Of the `formulas` (`find_formulas`) it
    contains the first ones on which both halves of the selection windows agree and that add enough.
    The shares are those of the locked windows.
    """
    without_formula = fits.fit()
    if without_formula.excess <= 0:
        return None

    # Formulas join in the order of their likelihood, until one is not stable or adds too little.
    choices: list[FormulaChoice] = []
    share = 0.0
    for formula in formulas:
        more_choices = [*choices, formula]
        if not _stable(fits, more_choices):
            break
        larger_share = share_removed(without_formula, fits.fit(_joined(more_choices)))
        if choices and larger_share < share + WORTH_A_SECOND:
            break
        choices = more_choices
        share = larger_share

    # A smooth formula must remove more: any smooth curve resembles any other.
    smooth = any(choice.formula.smooth for choice in choices)
    least_share = MIN_SMOOTH_SHARE if smooth else MIN_FORMULA_SHARE
    if not choices or share < least_share:
        return None
    return _proposal_of(blocks, problem, fits, without_formula, choices)


def _plausible_sizes(sensor: str, problem: LinearisedProblem) -> np.ndarray:
    """
    Return a factor P of the plausible covariance ``P P'`` of the catalogue's parameters, (q, q).

    It is that of the priors, except for a cause in the table or the clock, which acts on both
    sensors: its estimate from the other sensor limits what it may explain in this one.
    """
    plausible = np.diag(problem.space.prior_sd)
    (other,) = (each for each in SENSORS if each != sensor)
    if other not in problem.space.sensors:
        return plausible
    for question in problem.questions:
        acts_on = question.effect.acts_on
        if question.sensor not in SENSORS and other in acts_on and len(acts_on) > 1:
            # Covariance of its parameters, the last ones, by the other sensor, with the baseline.
            parameters = list(question.parameters)
            n = len(parameters)
            covariance = problem.evidence.known_from(other, [*problem.search.baseline, *parameters])
            factor = np.linalg.cholesky(covariance[-n:, -n:])
            plausible[np.ix_(parameters, parameters)] = OTHER_SENSOR * factor
    return plausible


def _grammar(blocks: BlockMeans) -> tuple[Formula, ...]:
    """Return the formulas that are tried in a recording."""
    # To two digits, because the texts contain time constants.
    duration = float(f'{max(float(np.ptp(blocks.time)), 1.0):.2g}')
    return grammar(blocks.ref.joint_angle.shape[1], blocks.warms, duration)


def _joined(choices: Sequence[FormulaChoice]) -> np.ndarray:
    """Return the columns of all choices over the blocks, shape (b, k, 3)."""
    return np.concatenate([choice.columns for choice in choices], axis=1)


def _stable(fits: BlockFits, choices: Sequence[FormulaChoice]) -> bool:
    """
    Return whether the halves of the recording agree on the amplitudes of the last choice.

    Their difference is on average below three standard deviations. Or its squares sum to less than
    a tenth of those of the amplitudes fitted to both halves, all in standard deviations.
    """
    columns = _joined(choices)
    early = fits.fit(columns, half=0)
    late = fits.fit(columns, half=1)
    both = fits.fit(columns)
    last = slice(-choices[-1].columns.shape[1], None)
    difference_sds = (early.amplitudes - late.amplitudes) / np.sqrt(early.sd**2 + late.sd**2)
    squared_difference = difference_sds[last] ** 2
    squared_amplitude = (both.amplitudes / both.sd)[last] ** 2
    return bool(
        squared_difference.mean() < 9.0 or squared_difference.sum() < 0.1 * squared_amplitude.sum()
    )


def _proposal_of(
    blocks: BlockMeans,
    problem: LinearisedProblem,
    fits: BlockFits,
    without_formula: BlockFit,
    choices: Sequence[FormulaChoice],
) -> Proposal:
    """Return the chosen formulas as effects with their amplitudes, fitted together."""
    shapes = []
    for choice in choices:
        shapes += _shapes(fits, choices, choice)
    shapes = shapes[:MOST_TERMS]
    columns = np.concatenate([shape.columns for shape in shapes], axis=1)
    after = fits.fit(columns)

    # Effects, with names that are not in the catalogue.
    catalogue = problem.baseline.catalogue
    used_names = {name for _, name in catalogue.effects(problem.baseline.joint_names)}
    families: set[str] = set()
    effects = []
    for number, shape in enumerate(shapes):
        amplitudes = after.amplitudes[number]
        effects.append(_effect(blocks.sensor, number, shape, amplitudes, used_names))
        families |= shape.formula.family

    # Formulas of the same evidence, of which these are the simplest.
    alike = []
    for formula in choices[0].alike[:SHOWN_ALIKE]:
        phase = ' in any phase' if len(formula.columns) > 1 else ''
        alike.append(_joined_text(formula.columns[0]) + phase)

    # Axes with a significant amplitude and at least a tenth of the largest output.
    significant = np.abs(after.amplitudes) > CONCERNED_SDS * after.sd
    rms = np.sqrt((columns**2).mean(axis=0))
    output = (np.abs(after.amplitudes) * rms).sum(axis=0)
    axes = []
    for k, axis in enumerate(AXES):
        if significant[:, k].any() and output[k] > 0.1 * output.max():
            axes.append(axis)
    rms_of_terms = []
    for k, amplitudes in enumerate(after.amplitudes):
        rms_of_terms.append(float(np.sqrt((rms[k] ** 2 * amplitudes**2).sum())))

    # The excess is a sum of squares; its reduction as a root mean square.
    share = share_removed(without_formula, after)
    return Proposal(
        sensor=blocks.sensor,
        effects=tuple(effects),
        values=tuple(after.amplitudes),
        sds=tuple(after.sd),
        family=frozenset(families),
        axes=tuple(axes),
        share=share,
        ci95=share_interval(without_formula, after, np.random.default_rng(1)),
        reduction=1.0 - float(np.sqrt(max(1.0 - share, 0.0))),
        p_value=choices[0].p_value,
        alike=tuple(alike),
        nearest=_nearest(fits, without_formula, problem),
        motion=_motion(effects),
        sizes=tuple(rms_of_terms),
    )


@dataclass(frozen=True, eq=False)
class _Shape:
    """One combination of the columns of a formula, with one amplitude on each axis."""

    columns: np.ndarray
    """Means over the blocks, shape (b, 1, 3)."""
    text: Column
    """The combination as text."""
    formula: Formula
    """The formula of the columns."""


def _shapes(
    fits: BlockFits, choices: Sequence[FormulaChoice], choice: FormulaChoice
) -> list[_Shape]:
    """
    Return the one or two shapes that contain most of the amplitudes of a choice.

    The amplitudes are fitted together with the other `choices`.
    """
    formula = choice.formula
    columns = choice.columns
    if len(formula.columns) == 1:
        return [_Shape(columns, formula.columns[0], formula)]

    # Amplitudes (k columns, 3 axes) in units of output: A = U S V'. A column of U is a combination
    # of columns that all axes have in common, with the amplitudes S V'.
    first = sum(other.columns.shape[1] for other in choices[: choices.index(choice)])
    amplitudes = fits.fit(_joined(choices)).amplitudes[first : first + columns.shape[1]]
    scale = np.sqrt((columns**2).mean(axis=(0, 2)))
    combinations, sizes, _ = np.linalg.svd(amplitudes * scale[:, None])
    n_shapes = 1 if sizes[0] ** 2 > ONE_SHAPE * (sizes**2).sum() else 2
    shapes = []
    for weights in (combinations[:, :n_shapes] / scale[:, None]).T:
        # Rounded as the text has them, so that the text reproduces the fit.
        weights = weights / weights[np.argmax(np.abs(weights))]
        if formula.phased:
            phase = float(f'{np.arctan2(weights[1], weights[0]):.4g}')
            weights = np.array([np.cos(phase), np.sin(phase)])
            text: Column = formula.phased.format(phase=phase).replace('- -', '+ ')
        else:
            # Columns with 3 % of the largest output or less are omitted from the text.
            output = np.abs(weights) * scale
            rounded = np.array([float(f'{weight:.4g}') for weight in weights])
            weights = np.where(output > 0.03 * np.max(output), rounded, 0.0)
            text = _summed(formula.columns, weights)
        column = np.einsum('bka,k->ba', columns, weights)
        shapes.append(_Shape(column[:, None], text, formula))
    return shapes


def _summed(columns: Sequence[Column], weights: Sequence[float] | np.ndarray) -> Column:
    """Return the text, or three texts, of a weighted sum of columns."""
    if not all(isinstance(column, str) for column in columns):
        of_axes = zip(*columns, strict=True)
        return tuple(_weighted_sum(of_axis, weights) for of_axis in of_axes)
    return _weighted_sum(columns, weights)


def _weighted_sum(columns: Sequence[Any], weights: Sequence[float] | np.ndarray) -> str:
    """Return the text of a weighted sum of texts, without terms of weight zero."""
    terms = []
    for column, weight in zip(columns, weights):
        if weight:
            terms.append(f'{weight:g} * {column}' if weight != 1.0 else column)
    return ' + '.join(terms)


def _effect(
    sensor: str,
    number: int,
    shape: _Shape,
    amplitudes: np.ndarray,
    used_names: Collection[str],
) -> Effect:
    """
    Return a shape as an effect of a sensor, with its amplitudes on the three axes, shape (3,).

    Its name is the one with the place `number` among the unused names of proposed effects.
    """
    text = shape.text
    unit = shape.formula.unit('m/s^2' if sensor == SENSORS[0] else 'rad/s')
    largest = float(np.abs(amplitudes).max())
    names = (f'{PREFIXES[sensor]}_proposed_{k}' for k in range(1, 100))
    unused_names = [name for name in names if name not in used_names]
    return term(
        unused_names[number],
        sensor=sensor,
        column=text if isinstance(text, str) else list(text),
        unit=unit,
        tolerance=_two_digits(0.1 * largest),
        tolerance_reason='a tenth of the estimate',
        prior_sd=_two_digits(10 * largest),
        largest=_two_digits(3 * largest),
        text=(
            f'The {sensor} output follows {_joined_text(text)}: a formula that a diagnosis'
            ' proposed, its cause is not known.'
        ),
    )


def _two_digits(value: float) -> float:
    """Return a value rounded to two digits."""
    return float(f'{value:.2g}')


def _joined_text(text: Column) -> str:
    """Return the text of a column; three texts, one for each axis, in brackets."""
    return text if isinstance(text, str) else f'({", ".join(text)})'


def _text_of(effect: Effect) -> str:
    """Return the formula of a proposed effect."""
    assert effect.definition is not None, 'a proposed effect has a formula'
    column = effect.definition['column']
    return _joined_text(column if isinstance(column, str) else tuple(column))


def _size(effect: Effect, values: np.ndarray, sd: np.ndarray) -> str:
    """Return the largest amplitude of an effect with its sd, unit and axis as text."""
    k = int(np.argmax(np.abs(values)))
    factor, unit = for_people(effect.unit_of(k), effect.sensor)
    size = ' ± '.join(with_sd(values[k] * factor, sd[k] * factor))
    return f'{size} {unit} on {effect.sensor} {AXES[k]}'


def _motion(effects: Iterable[Effect]) -> str:
    """Return the text of the first motion of each effect, which would confirm it."""
    first = dict.fromkeys(effect.motion[0] for effect in effects if effect.motion)
    return '; '.join(dict.fromkeys(ALL_MOTIONS[name] for name in first if name in ALL_MOTIONS))


def _nearest(
    fits: BlockFits, without_formula: BlockFit, problem: LinearisedProblem
) -> tuple[str, float] | None:
    """
    Return (effect of the catalogue, share that it removes) of the effect that removes most.

    None if all effects that act on the sensor are in the model.
    """
    best: tuple[str, float] | None = None
    acting = np.concatenate(fits.blocks.index)  # parameters that act on the sensor
    for question in problem.questions:
        if set(question.parameters) <= fits.used:
            continue
        if not np.isin(question.parameters, acting).any():
            continue
        share = share_removed(without_formula, fits.fit(more=question.parameters))
        if best is None or share > best[1]:
            best = (question.name, share)
    return best
