"""
A formula for the unexplained residual.

Search, test on held-out windows, description and a term for a model.
"""

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
"""Share of the excess that a formula removes from held-out windows at least."""
WORTH_A_SECOND = 0.1
"""Share that a second formula adds at least."""
MOST_TERMS = 2
ONE_SHAPE = 0.9
"""Share of a formula's amplitudes, all axes, that one shape must have to replace all of it."""
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
    """Their amplitudes on the three axes, SI."""
    sds: tuple[np.ndarray, ...]
    """Standard deviations, with the misfit in them."""
    family: frozenset[str]
    """Quantities in them."""
    axes: tuple[str, ...]
    """Axes of the sensor on which they show."""
    share: float
    """Share of the rest that they remove from held-out windows, in squares."""
    ci95: tuple[float, float]
    """Its interval."""
    reduction: float
    """By how much the rms beyond noise falls there, as a share."""
    p_value: float
    """Probability of the first by noise, times the number of formulas."""
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
        parts = [
            f'{_size(effect, value, sd)}'
            for effect, value, sd in zip(self.effects, self.values, self.sds)
        ]
        text = (
            f'{100 * self.share:.0f} % of it ({100 * self.ci95[0]:.0f} to {100 * self.ci95[1]:.0f}'
            ' %, on windows held out) follows '
            + ' and '.join(f'{column}, {part}' for column, part in zip(self.columns, parts))
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
    Return the formulas that a sensor's residual follows most likely.

    Each one is in addition to the earlier ones, and there are at most `MOST_TERMS`.

    They are chosen on the selection windows, with all plausible contributions of the catalogue
    projected out.
    """
    search = FormulaSearch(
        blocks,
        _grammar(blocks),
        _plausible(blocks.sensor, problem),
        reference_temperature=problem.recording.model.temperature_ref_c,
    )
    found: list[FormulaChoice] = []
    while len(found) < MOST_TERMS:
        if found:
            search.take(found[-1])
        choice = search.best()
        if choice is None:
            break
        found.append(choice)
    return found


def propose(
    blocks: BlockMeans,
    problem: LinearisedProblem,
    fits: BlockFits,
    *,
    formulas: Sequence[FormulaChoice],
) -> Proposal | None:
    """
    Return a Proposal for the residual of a sensor with the chosen effects.

    Or None where no formula removes most of it.

    Of the `formulas` (`find_formulas`) the first ones are taken on which both halves of the
    selection windows agree and that add enough; the share is from the locked windows with the
    findings in the model.
    """
    plain = fits.fit()
    if plain.excess <= 0:
        return None
    choices: list[FormulaChoice] = []
    share = 0.0
    for found in formulas:
        if not _stable(fits, [*choices, found]):
            break
        grown = share_removed(plain, fits.fit(_joined([*choices, found])))
        if choices and grown < share + WORTH_A_SECOND:
            break
        choices = [*choices, found]
        share = grown
    needed = (
        MIN_SMOOTH_SHARE if any(choice.formula.smooth for choice in choices) else MIN_FORMULA_SHARE
    )
    if not choices or share < needed:
        return None
    return _proposal_of(blocks, problem, fits, plain, choices)


def _plausible(sensor: str, problem: LinearisedProblem) -> np.ndarray:
    """
    Return a factor of the covariance that the catalogue's parameters may have, shape (q, q).

    A cause in the table acts on both sensors: its explained share here is limited by its estimate
    there.
    """
    plausible = np.diag(problem.space.prior_sd)
    (other,) = (each for each in SENSORS if each != sensor)
    if other not in problem.space.sensors:
        return plausible
    for question in problem.questions:
        if (
            question.sensor not in SENSORS
            and other in question.effect.acts_on
            and len(question.effect.acts_on) > 1
        ):
            own = list(question.parameters)
            known = problem.evidence.known_from(other, [*problem.search.baseline, *own])[
                -len(own) :, -len(own) :
            ]
            plausible[np.ix_(own, own)] = OTHER_SENSOR * np.linalg.cholesky(known)
    return plausible


def _grammar(blocks: BlockMeans) -> tuple[Formula, ...]:
    duration = float(f'{max(float(np.ptp(blocks.time)), 1.0):.2g}')
    return grammar(blocks.ref.joint_angle.shape[1], blocks.warms, duration)


def _joined(choices: Sequence[FormulaChoice]) -> np.ndarray:
    return np.concatenate([choice.columns for choice in choices], axis=1)


def _stable(fits: BlockFits, choices: Sequence[FormulaChoice]) -> bool:
    """
    Return whether the halves of the recording agree on the last choice within their precision.
    """
    width = choices[-1].columns.shape[1]
    early, late, whole = (fits.fit(_joined(choices), half=half) for half in (0, 1, None))
    apart = ((early.amplitudes - late.amplitudes) / np.sqrt(early.sd**2 + late.sd**2))[-width:]
    strength = (whole.amplitudes / whole.sd)[-width:]
    return bool((apart**2).mean() < 9.0 or (apart**2).sum() < 0.1 * (strength**2).sum())


def _proposal_of(
    blocks: BlockMeans,
    problem: LinearisedProblem,
    fits: BlockFits,
    plain: BlockFit,
    choices: Sequence[FormulaChoice],
) -> Proposal:
    """Return the chosen formulas as effects with their amplitudes, fitted together."""
    terms = []
    for choice in choices:
        terms += _shapes(fits, choices, choice)
    terms = terms[:MOST_TERMS]
    columns = np.concatenate([column for column, _, _ in terms], axis=1)
    after = fits.fit(columns)

    # Names that the catalogue has not.
    taken = {name for _, name in problem.baseline.catalogue.effects(problem.baseline.joint_names)}
    families: set[str] = set()
    effects = []
    for number, (_, text, formula) in enumerate(terms):
        amplitudes = after.amplitudes[number]
        effects.append(_effect(blocks.sensor, number, text, formula, amplitudes, taken))
        families |= formula.family

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
    share = share_removed(plain, after)
    return Proposal(
        blocks.sensor,
        tuple(effects),
        tuple(after.amplitudes),
        tuple(after.sd),
        frozenset(families),
        tuple(axes),
        share,
        share_interval(plain, after, np.random.default_rng(1)),
        1.0 - float(np.sqrt(max(1.0 - share, 0.0))),
        choices[0].p_value,
        tuple(alike),
        _nearest(fits, plain, problem),
        _motion(effects),
        tuple(rms_of_terms),
    )


def _shapes(
    fits: BlockFits, choices: Sequence[FormulaChoice], choice: FormulaChoice
) -> list[tuple[np.ndarray, Column, Formula]]:
    """
    Return (column means (b, 1, 3), text or three texts, Formula) of shapes.

    They are the one or two shapes that hold a choice's amplitudes.
    """
    formula = choice.formula
    columns = choice.columns
    if len(formula.columns) == 1:
        return [(columns, formula.columns[0], formula)]

    # Amplitudes (k columns, 3 axes) in units of output: A = U S V'. A column of U is a combination
    # of columns that all axes have in common, with the amplitudes S V'.
    first = sum(other.columns.shape[1] for other in choices[: choices.index(choice)])
    amplitudes = fits.fit(_joined(choices)).amplitudes[first : first + columns.shape[1]]
    scale = np.sqrt((columns**2).mean(axis=(0, 2)))
    left, sizes, _ = np.linalg.svd(amplitudes * scale[:, None])
    count = 1 if sizes[0] ** 2 > ONE_SHAPE * (sizes**2).sum() else 2
    shapes = []
    for weights in (left[:, :count] / scale[:, None]).T:
        # Rounded as the text has them, so that the text reproduces the fit.
        weights = weights / weights[np.argmax(np.abs(weights))]
        if formula.phased:
            phase = float(f'{np.arctan2(weights[1], weights[0]):.4g}')
            weights = np.array([np.cos(phase), np.sin(phase)])
            text: Column = formula.phased.format(phase=phase).replace('- -', '+ ')
        else:
            output = np.abs(weights) * scale
            rounded = np.array([float(f'{weight:.4g}') for weight in weights])
            weights = np.where(output > 0.03 * np.max(output), rounded, 0.0)
            text = _summed(formula.columns, weights)
        shapes.append((np.einsum('bka,k->ba', columns, weights)[:, None], text, formula))
    return shapes


def _summed(columns: Sequence[Column], weights: Sequence[float] | np.ndarray) -> Column:
    """Return the text, or three texts, of a weighted sum of columns."""
    if not all(isinstance(column, str) for column in columns):
        of_axes = zip(*columns, strict=True)
        return tuple(_weighted_sum(of_axis, weights) for of_axis in of_axes)
    return _weighted_sum(columns, weights)


def _weighted_sum(columns: Sequence[Any], weights: Sequence[float] | np.ndarray) -> str:
    """Return the text of a weighted sum of texts; terms of weight zero are left out."""
    terms = []
    for column, weight in zip(columns, weights):
        if weight:
            terms.append(f'{weight:g} * {column}' if weight != 1.0 else column)
    return ' + '.join(terms)


def _effect(
    sensor: str,
    number: int,
    text: Column,
    formula: Formula,
    values: np.ndarray,
    taken: Collection[str],
) -> Effect:
    unit = formula.unit('m/s^2' if sensor == SENSORS[0] else 'rad/s')
    largest = float(np.abs(values).max())
    names = (f'{PREFIXES[sensor]}_proposed_{k}' for k in range(1, 100))
    free = [name for name in names if name not in taken][number]
    return term(
        free,
        sensor=sensor,
        column=text if isinstance(text, str) else list(text),
        unit=unit,
        tolerance=_digits(0.1 * largest),
        tolerance_reason='a tenth of the estimate',
        prior_sd=_digits(10 * largest),
        largest=_digits(3 * largest),
        text=(
            f'The {sensor} output follows {_joined_text(text)}: a formula that a diagnosis'
            ' proposed, its cause is not known.'
        ),
    )


def _digits(value: float) -> float:
    return float(f'{value:.2g}')


def _joined_text(text: Column) -> str:
    return text if isinstance(text, str) else f'({", ".join(text)})'


def _text_of(effect: Effect) -> str:
    assert effect.definition is not None, 'a proposed effect has a formula'
    column = effect.definition['column']
    return _joined_text(column if isinstance(column, str) else tuple(column))


def _size(effect: Effect, values: np.ndarray, sd: np.ndarray) -> str:
    k = int(np.argmax(np.abs(values)))
    factor, unit = for_people(effect.unit_of(k), effect.sensor)
    size = ' ± '.join(with_sd(values[k] * factor, sd[k] * factor))
    return f'{size} {unit} on {effect.sensor} {AXES[k]}'


def _motion(effects: Iterable[Effect]) -> str:
    first = dict.fromkeys(effect.motion[0] for effect in effects if effect.motion)
    return '; '.join(dict.fromkeys(ALL_MOTIONS[name] for name in first if name in ALL_MOTIONS))


def _nearest(
    fits: BlockFits, plain: BlockFit, problem: LinearisedProblem
) -> tuple[str, float] | None:
    """Return (effect, share removed) of the best fit in the catalogue."""
    best: tuple[str, float] | None = None
    for question in problem.questions:
        if set(question.parameters) <= fits.used or not any(
            np.isin(question.parameters, index).any() for index in fits.blocks.index
        ):
            continue
        share = share_removed(plain, fits.fit(more=question.parameters))
        if best is None or share > best[1]:
            best = (question.name, share)
    return best
