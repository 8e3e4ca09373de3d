"""Test of all pairs of effects, for causes that no single effect explains."""

from collections import defaultdict
from collections.abc import Sequence
from itertools import combinations

import numpy as np
import scipy.linalg

from imu_calibration.estimation.scaled_solve import JITTER
from imu_calibration.selection.questions import Question
from imu_calibration.selection.search import PENALTY, Search

UNIQUE = 0.05
"""Least share of the signal of each member that the other cannot imitate."""
TRIED = 3
"""Pairs from which a search is started."""


def best_pairs(search: Search) -> list[list[Question]]:
    """
    Return the pairs that lower the loss most and are possible, the best first, at most three.

    The normal matrix with the baseline projected out and each effect's block scaled to the unit matrix gives a system of two blocks for
    each pair; systems of one shape are solved together. Each member must keep some signal that is not collinear with its mate. That each
    is significant without its mate is tested by the search from the pair (`Search.run`).
    """
    blocks = _Blocks(search)
    shapes = defaultdict(list)
    for one, two in combinations(range(len(search.questions)), 2):
        names = {search.questions[one].name, search.questions[two].name}
        if len(names) == 2 and not names & search.resolved:
            shapes[blocks.size(one), blocks.size(two)].append((one, two))
    scored = [entry for pairs in shapes.values() for entry in blocks.score(pairs)]
    best = []
    for _, one, two in sorted(scored, reverse=True):
        pair = [search.questions[one], search.questions[two]]
        if {q.name for q in pair} not in [{q.name for q in known} for known in best] and all(search.allowed(pair, each) for each in pair):
            best.append(pair)
        if len(best) == TRIED:
            break
    return best


class _Blocks:
    """Normal equations of all questions, baseline projected out, each question's own block the unit matrix."""

    def __init__(self, search):
        self.questions, (information, right) = search.questions, search.evidence.equations()
        base, free = list(search.baseline), [k for question in search.questions for k in question.parameters]
        factor = scipy.linalg.cho_factor(information[np.ix_(base, base)])
        cross = information[np.ix_(base, free)]
        matrix = information[np.ix_(free, free)] - cross.T @ scipy.linalg.cho_solve(factor, cross)
        right = right[free] - cross.T @ scipy.linalg.cho_solve(factor, right[base])
        ends = np.cumsum([0, *(len(question.parameters) for question in search.questions)])
        self.at = [slice(a, b) for a, b in zip(ends, ends[1:])]
        for at in self.at:
            scale = np.sqrt(np.diag(matrix)[at])
            own = matrix[at, at] / np.outer(scale, scale)
            lower = np.linalg.cholesky(own + 1e4 * JITTER * np.eye(len(own))) * scale[:, None]
            matrix[at] = np.linalg.solve(lower, matrix[at])
            matrix[:, at] = np.linalg.solve(lower, matrix[:, at].T).T
            right[at] = np.linalg.solve(lower, right[at])
        self.matrix, self.right = matrix, right

    def size(self, number):
        """Return the number of parameters of a question."""
        return len(self.questions[number].parameters)

    def score(self, pairs: Sequence[tuple[int, int]]):
        """Yield (fall of the loss in nats less the penalty, one, two) of pairs of one shape with members that are not collinear."""
        places = np.array([[*range(*self.at[a].indices(len(self.right))), *range(*self.at[b].indices(len(self.right)))] for a, b in pairs])
        n_first = self.size(pairs[0][0])
        systems = self.matrix[places[:, :, None], places[:, None, :]] + 1e4 * JITTER * np.eye(places.shape[1])
        values = np.linalg.solve(systems, self.right[places][:, :, None])[:, :, 0]
        fall = np.einsum('ki,ki->k', values, self.right[places])
        cross, parts = systems[:, :n_first, n_first:], (values[:, :n_first], values[:, n_first:])
        shared = [np.einsum('kij,ki->kj', cross, parts[0]), np.einsum('kij,kj->ki', cross, parts[1])]
        for k, (one, two) in enumerate(pairs):
            unique = [1 - (other[k] @ other[k]) / max(part[k] @ part[k], 1e-300) for part, other in zip(parts, shared)]
            if min(unique) > UNIQUE:
                yield 0.5 * fall[k] - PENALTY * sum(self.questions[q].penalty for q in (one, two)), one, two
