"""
The recording reduced around a point of linearisation, and the search on it.

It also holds the decision whether to relinearise.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from typing import AbstractSet

import numpy as np

from imu_calibration.effects.base import Effect
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.scaled_solve import solve_normal
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.window import Window
from imu_calibration.references.turntable.selection.explained_windows import ExplainedWindows
from imu_calibration.references.turntable.selection.extended_model import extended_model
from imu_calibration.references.turntable.selection.noise_beside_effects import (
    in_trusted_band,
    noise_before_fit,
    noise_beside_effects,
)
from imu_calibration.references.turntable.selection.parameter_space import (
    ParameterSpace,
    counted_from_values,
    normal_matrix,
    parameter_space,
    questions,
)
from imu_calibration.references.turntable.selection.reduced_recording import (
    ReducedRecording,
    make_bank,
    mean_arms,
    reduce_recording,
)
from imu_calibration.references.turntable.selection.window_evidence import WindowEvidence, folds_of
from imu_calibration.selection.questions import (
    Question,
    smooth_parameters,
    time_constants,
    with_exchanged,
)
from imu_calibration.selection.search import FAMILY_WISE, Search

DELAY_FREQUENCY = 2 * np.pi * 3.0
"""Assumed angular frequency of motions in the curvature of a delay, rad/s."""
TOO_COARSE = 4.0
"""Evidence of a curvature above which the columns are relinearised, nats."""
BILINEAR = 2e-3
"""Relative change of the matrix that an omitted effect may have caused."""


@dataclass(frozen=True, eq=False)
class SearchedWindows:
    """Windows of one recording and the effects under test: the same at each linearisation."""

    windows: Sequence[Window]
    """Without clipped samples."""
    table: Table
    """The reference."""
    baseline: SensorModel
    """The model to be extended."""
    effects: Sequence[Effect]
    """Candidate effects."""
    locked: np.ndarray
    """
    Mask of the windows reserved for the gain: they have columns, but are excluded from noise, fits
    and choices, shape (k,).
    """
    bias_processes: dict | None = None
    """Sensor -> its bias processes, where measured separately."""
    any_size: bool = False
    """Whether sizes above those of any known instrument are allowed."""
    resolved: AbstractSet[str] = frozenset()
    """Effects that were compared with each other already, as for `Search`."""

    def linearised(
        self,
        point: tuple[SensorModel, np.ndarray] | None = None,
        *,
        effects: Sequence[Effect] | None = None,
    ) -> 'LinearisedProblem':
        """
        Return the problem at a point, by default the baseline's solution.

        With columns of some `effects`, by default of all.
        """
        searched = self if effects is None else replace(self, effects=effects)
        return LinearisedProblem(searched, point)


class LinearisedProblem:
    """
    One linearisation of the windows: columns, noise, evidence and search.

    Parameters
    ----------
    searched : SearchedWindows
    point : (SensorModel, array), optional
        Point of linearisation; default: the baseline's solution.

    """

    def __init__(
        self, searched: SearchedWindows, point: tuple[SensorModel, np.ndarray] | None = None
    ):
        baseline = searched.baseline
        effects = searched.effects
        self.baseline = baseline
        self.effects = effects
        self.locked = searched.locked
        self.duration = max(float(window.time[-1]) for window in searched.windows)
        """Duration of the recording, s."""
        self.constants = time_constants(self.duration)
        """Time constants of the bank, s."""

        # Reduce all windows with the columns of all effects.
        model, values = point or _start(baseline, effects)
        model = replace(model, folded_arms=mean_arms(model, values))
        recording = reduce_recording(
            searched.windows,
            searched.table,
            model,
            values=values,
            bank=make_bank(effects, self.constants, model, values=values),
        )

        # Places of the parameters of the baseline in the model with all effects.
        places = range(len(values))
        parts = [places[model.slices[effect.key]] for effect in baseline.effects]
        in_baseline = tuple(chain.from_iterable(parts))

        # Noise, fits and choices are from the windows that are not locked. A first linearisation is
        # at the start of the baseline: the residuals of all windows move to its solution.
        of_selection = recording.select(~self.locked)
        if point is None:
            of_selection = _at_baseline(of_selection, baseline, in_baseline)
            recording = recording.rebased(of_selection.values)
        self.all_samples = parameter_space(of_selection, baseline)
        """The selection windows with all of their samples."""
        space = in_trusted_band(self.all_samples)
        self.space = replace(space, recording=recording)
        """All windows, locked ones included, in the trusted band."""
        candidates = questions(space, effects)
        self.noise = noise_beside_effects(
            space, smooth_parameters(candidates), searched.bias_processes
        )
        self.evidence = WindowEvidence(space, self.noise, folds_of(space.recording.kind))
        self.search = Search(
            self.evidence,
            in_baseline,
            candidates,
            encoder_step=space.recording.encoder_step,
            any_size=searched.any_size,
            resolved=searched.resolved,
        )

    def asking_any_size(self) -> 'LinearisedProblem':
        """Return the same, with a search that allows sizes above those of any known instrument."""
        other = copy(self)
        other.search = self.search.asking_any_size()
        # What is cached belongs to the search of this problem.
        other.__dict__.pop('explained', None)
        return other

    @property
    def recording(self) -> ReducedRecording:
        """The reduced recording, all of its windows."""
        return self.space.recording

    @property
    def questions(self) -> Sequence[Question]:
        """Candidate effects."""
        return self.search.questions

    @cached_property
    def explained(self) -> ExplainedWindows:
        """Excess over noise in the selection windows, and the share of it that effects remove."""
        return ExplainedWindows(self.evidence, self.search)

    @cached_property
    def locked_samples(self) -> ParameterSpace:
        """The locked windows, with all samples: for the gain only."""
        return replace(self.all_samples, recording=self.recording.select(self.locked))

    def values(self, chosen: Sequence[Question]) -> np.ndarray:
        """
        Return all parameters of the space for a choice, fitted to the selection windows.

        The parameters of effects that are neither chosen nor in the baseline are zero, shape (q,).
        """
        return self.absolute(self.search.values(chosen))

    def absolute(self, values: np.ndarray) -> np.ndarray:
        """
        Return the parameters of the space from fitted ones, shape (q,).

        The fitted parameters of the baseline are changes from the linearisation
        (`counted_from_values`), whose values are added.
        """
        values = np.array(values)
        is_change = counted_from_values(self.recording.model, self.baseline)
        values[: len(is_change)] += np.where(is_change, self.recording.values, 0.0)
        return values

    def judged_by(self, judge: 'LinearisedProblem') -> WindowEvidence:
        """Return the evidence with the noise and the band of another linearisation."""
        space = replace(
            self.evidence.space,
            slow_only=judge.space.slow_only,
            slow_variance=judge.space.slow_variance,
        )
        return WindowEvidence(space, judge.noise, self.evidence.fold)

    def needs_another(self, chosen: Sequence[Question]) -> bool:
        """
        Return whether the choice must be linearised again.

        A warm-up of the bank has no columns of its own yet; of other effects the evidence of the
        curvature is too large.
        """
        for question in chosen:
            if '@' in question.label or self.curvature_shows(chosen, question) > TOO_COARSE:
                return True
        return False

    def curvature_shows(self, chosen: Sequence[Question], question: Question) -> float:
        """
        Return the evidence that separates an effect of the choice from its tangent, nats.

        That is the fall of the loss by the effect times the squared relative error of its tangent.
        """
        without = self.search.indices([q for q in chosen if q is not question])
        fall = self.evidence.loss(without) - self.evidence.loss(self.search.indices(chosen))
        values = self.values(chosen)
        return fall * _curvature(question, values, self.recording.model, self.duration) ** 2

    def windows_agree(self, chosen: Sequence[Question], question: Question) -> bool:
        """
        Return whether an effect is also significant against its scatter over windows.

        The scatter is judged by `WindowEvidence.p_value_by_scatter`.
        """
        p_value = self.evidence.p_value_by_scatter(self.search.indices(chosen), question.parameters)
        return p_value * len(self.questions) < FAMILY_WISE

    def acts_beside(self, chosen: Sequence[Question]) -> bool:
        """
        Return whether the columns are linearised at a warped effect that is not chosen.

        Such an effect is a lag, a delay or an error of the table, with values that are not zero.
        """
        in_choice = self._effects_with(chosen)
        model = self.recording.model
        for effect in model.effects:
            is_other = effect.warp is not None and effect.key not in in_choice
            if is_other and np.any(model.point_of(effect)):
                return True
        return False

    def point(self, chosen: Sequence[Question]) -> tuple[SensorModel, np.ndarray]:
        """
        Return the point of linearisation (model, values) for this choice.

        The model has columns of all effects, the amplitudes of those that are not chosen are zero.
        """
        # Effects with a time constant have columns only in a model with them.
        model = extended_model(self.baseline, self.effects)
        for question in chosen:
            if question.effect.time_constant:
                model = model.with_effect(question.sensor, question.name)

        # The fitted values of the effects that this linearisation has already.
        values = self.values(chosen)
        in_choice = self._effects_with(chosen)
        start = model.start()
        for effect in model.effects:
            part = model.slices[effect.key]
            part_here = self.recording.model.slices.get(effect.key)
            if part_here is not None:
                start[part] = values[part_here]
                if effect.time_constant:
                    # A step along the tangent may pass zero, or far beyond the duration.
                    shortest = 0.25 * self.constants[0]
                    longest = 4.0 * self.constants[-1]
                    start[part.stop - 1] = np.clip(start[part.stop - 1], shortest, longest)
            if effect.key not in in_choice:
                start[part][: effect.n_amplitudes] = 0.0

        # Warm-ups of the bank join the model.
        for question in chosen:
            if '@' in question.label:
                start[model.slices[question.effect.key]] = self._warm_up(chosen, question, values)
        return model.at(start), start

    def _effects_with(self, chosen: Sequence[Question]) -> set[tuple[str, str]]:
        """Return the keys of the effects of the baseline and of a choice."""
        return {question.effect.key for question in chosen}.union(self.baseline.slices)

    def _warm_up(
        self, chosen: Sequence[Question], question: Question, values: np.ndarray
    ) -> np.ndarray:
        """
        Return amplitudes and time constant of a chosen warm-up of the bank.

        The time constant is at the minimum of a parabola through the losses of this and the two
        neighbouring time constants, over their logarithms.
        """
        number = int(question.label.split('@')[1])
        place = chosen.index(question)
        amplitudes = values[list(question.parameters)]
        near = [k for k in (number - 1, number, number + 1) if 0 <= k < len(self.constants)]
        if len(near) < 3:
            return np.append(amplitudes, self.constants[number])
        losses = []
        for k in near:
            other = next(q for q in self.questions if q.label == f'{question.name}@{k}')
            used = self.search.indices(with_exchanged(chosen, place, other))
            losses.append(self.evidence.loss(used))
        # Parabola a x^2 + b x + c over the logarithm relative to that of this time constant, with
        # the minimum at -b / (2 a), within the neighbours.
        logs = np.log(self.constants[near])
        curve = np.polyfit(logs - logs[1], losses, 2)
        shift = 0.0
        if curve[0] > 0:
            shift = np.clip(-curve[1] / (2 * curve[0]), logs[0] - logs[1], logs[2] - logs[1])
        return np.append(amplitudes, np.exp(logs[1] + shift))


def _start(baseline: SensorModel, effects: Sequence[Effect]) -> tuple[SensorModel, np.ndarray]:
    """Return (model of the baseline and all effects, its start values; zero without one)."""
    model = extended_model(baseline, effects)
    values = model.start()
    return model, np.where(np.isfinite(values), values, 0.0)


def _at_baseline(
    recording: ReducedRecording, baseline: SensorModel, in_baseline: Sequence[int]
) -> ReducedRecording:
    """
    Return the recording with residuals at the least-squares solution of the baseline.

    `in_baseline`: its parameters. With lever arms, which the columns depend on, two steps.
    """
    for _ in range(2 if baseline.arms else 1):
        space = in_trusted_band(parameter_space(recording, baseline))
        normal = normal_matrix(space, noise_before_fit(space))
        step, _ = solve_normal(
            normal, np.asarray(in_baseline), space.prior_sd, prior_mean=space.prior_mean
        )
        values = recording.values.copy()
        values[list(in_baseline)] += step
        recording = recording.rebased(values)
    return recording


def _curvature(
    question: Question, values: np.ndarray, model: SensorModel, duration: float
) -> float:
    """
    Return the relative error of the tangent of an effect at its estimate.

    For a lag it is its change from the linearisation times `DELAY_FREQUENCY`, for a time constant
    the logarithm of the ratio. For other effects it is `BILINEAR`: some are multiplied by the
    matrix of the sensor, which an omitted effect may have changed by that share.
    """
    effect = question.effect
    value = values[list(question.parameters)]
    if effect.warp is not None:
        change = np.max(np.abs(value - model.point_of(effect)))
        sensitivity = {'s': DELAY_FREQUENCY, 's/s': DELAY_FREQUENCY * duration}
        return change * sensitivity.get(str(effect.unit), 1.0)
    if effect.time_constant:
        return abs(np.log(max(value[-1], 1e-3) / model.point_of(effect)[-1]))
    return BILINEAR
