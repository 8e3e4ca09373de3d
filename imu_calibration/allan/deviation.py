"""
The overlapping Allan variance of a stream, at constant memory.

``sigma^2(m) = sum_k (S(k + 2m) - 2 S(k + m) + S(k))^2 / (2 m^2 M)`` with S the running sum of the samples and M the number of terms
(IEEE 1139). Up to `FULL` samples every position k counts; beyond, k moves in steps of m / FULL or so, by halving the rate once per
octave, which changes the variance by less than a thousandth of its uncertainty. Samples that are missing leave a hole in the running
sum: a term counts when nine tenths of both of its halves are there.
"""

import numpy as np

FULL = 65536
"""Largest number of samples per mean for which every position counts."""
PRESENT = 0.9
"""Smallest share of the samples of a mean that must be there."""
PER_OCTAVE = 2


def averaging_factors(n_samples: int, per_octave: int = PER_OCTAVE) -> np.ndarray:
    """
    Return the numbers of samples per mean at which the variance of `n_samples` is computed, integers in rising order.

    Spaced evenly in the logarithm, up to half of the samples. Beyond `FULL` they are multiples of a power of two, as the halved
    rates need.
    """
    if n_samples < 2:
        return np.zeros(0, np.int64)
    steps = np.arange(int(per_octave * np.log2(n_samples / 2)) + 1)
    wanted = 2.0 ** (steps / per_octave)
    unit = 2 ** octaves_beyond(wanted)
    return np.unique(np.rint(wanted / unit).astype(np.int64) * unit)


def octaves_beyond(factor: np.ndarray) -> np.ndarray:
    """Return the number of halvings of the rate that reduce a factor below `FULL`, integers."""
    return np.maximum(np.ceil(np.log2(np.maximum(factor, 1) / FULL) - 1e-9), 0).astype(np.int64)


class AllanSums:
    """
    Sums of squared second differences, added block by block over stretches without a break.

    Parameters
    ----------
    factors : ndarray of int, shape (n_scales,)
        From `averaging_factors`.
    n_columns : int
        Number of sensor axes.

    """

    def __init__(self, factors: np.ndarray, n_columns: int):
        self.factors = np.asarray(factors, np.int64)
        self.squares = np.zeros((len(factors), n_columns))
        self.terms = np.zeros(len(factors), np.int64)
        self.lengths: list[int] = []
        self._until: list[tuple[np.ndarray, np.ndarray]] = [(self.squares.copy(), self.terms.copy())]
        levels = octaves_beyond(self.factors)
        self._levels = [_Level(np.flatnonzero(levels == k), self.factors[levels == k] >> k, n_columns)
                        for k in range(int(levels.max(initial=0)) + 1)]
        self._offset, self._length = None, 0

    def push(self, values: np.ndarray, present: np.ndarray | None = None) -> None:
        """
        Add the next samples of the stretch.

        Parameters
        ----------
        values : ndarray, shape (n, n_columns)
            Readings at equal steps of time.
        present : ndarray of bool, shape (n,), optional
            False where a sample is missing; its value does not count.

        """
        if not len(values):
            return
        present = np.ones(len(values), bool) if present is None else present
        if self._offset is None:
            if not present.any():
                return
            self._offset = values[present][:1000].mean(axis=0)
        self._length += len(values)
        rows = np.ascontiguousarray((values - self._offset).T)
        rows[:, ~present] = 0.0
        self._take(rows, None if present.all() else present.astype(float))

    def _take(self, rows, counts):
        """Hand samples to the first level and halve the rate from level to level; `counts` None: none is missing."""
        for k, level in enumerate(self._levels):
            if k:
                rows, counts = level.halved(rows, counts)
            if not rows.shape[1]:
                return
            level.push(rows, counts, 2.0**k, self.squares, self.terms)

    def end_stretch(self) -> None:
        """Close the stretch; the next one is independent of it."""
        if self._length:
            self.lengths.append(self._length)
            self._until.append((self.squares.copy(), self.terms.copy()))
        self._offset, self._length = None, 0
        for level in self._levels:
            level.forget()

    def by_stretch(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the variances of each stretch, (n_stretches, n_scales, n_columns), and their numbers of terms, (n_stretches, n_scales)."""
        squares, terms = (np.diff(np.array(values), axis=0) for values in zip(*self._until))
        return squares / (2.0 * np.maximum(terms, 1)[:, :, None]), terms.astype(float)

    def variance(self) -> np.ndarray:
        """Return the Allan variances, shape (n_scales, n_columns); NaN without a term."""
        with np.errstate(invalid='ignore', divide='ignore'):
            return self.squares / (2.0 * self.terms[:, None])


class _Level:
    """Second differences at one rate: `factors` in samples of that rate, results to the rows `index`."""

    def __init__(self, index, factors, n_columns):
        self.index, self.factors = index, factors
        self.reach = 2 * int(factors.max(initial=1))
        self.n_columns = n_columns
        self.forget()

    def forget(self):
        """Begin anew."""
        self.sums = np.zeros((self.n_columns, 1))
        self.counts = None
        self.odd = None

    def halved(self, rows, counts):
        """Return sums of pairs of samples and how many samples are in each; a sample without a mate waits."""
        counts = np.ones(rows.shape[1]) if counts is None and self.odd is not None and self.odd[1] is not None else counts
        if self.odd is not None:
            rows = np.concatenate([self.odd[0], rows], axis=1)
            if counts is not None:
                before = np.ones(1) if self.odd[1] is None else self.odd[1]
                counts = np.concatenate([before, counts])
        n = rows.shape[1] // 2 * 2
        self.odd = (rows[:, n:], None if counts is None else counts[n:]) if n < rows.shape[1] else None
        pairs = rows[:, 0:n:2] + rows[:, 1:n:2]
        return pairs, None if counts is None else 0.5 * (counts[0:n:2] + counts[1:n:2])

    def push(self, rows, counts, size, squares, terms):
        """Add the second differences that end in the new samples, each the sum of `size` original ones."""
        old = self.sums.shape[1]
        self.sums = np.concatenate([self.sums, self.sums[:, -1:] + np.cumsum(rows, axis=1)], axis=1)
        if counts is not None or self.counts is not None:
            before = np.arange(float(old)) if self.counts is None else self.counts
            new = np.ones(rows.shape[1]) if counts is None else counts
            self.counts = np.concatenate([before, before[-1] + np.cumsum(new)])
        for where, m in zip(self.index, self.factors):
            first = max(old, 2 * m)
            if first >= self.sums.shape[1]:
                continue
            if self.counts is None:
                last, middle, begin = (self.sums[:, first - k:self.sums.shape[1] - k] for k in (0, m, 2 * m))
                difference = last - 2.0 * middle
                difference += begin
            else:
                difference = self._with_holes(first, m)
            squares[where] += np.einsum('ij,ij->i', difference, difference) / (m * size)**2
            terms[where] += difference.shape[1]
        self._shorten()

    def _with_holes(self, first, m):
        """Return m times the differences of neighbouring means of the samples that are there."""
        end = self.sums.shape[1]
        sums, counts = ([values[..., first - k:end - k] for k in (0, m, 2 * m)] for values in (self.sums, self.counts))
        late, early = counts[0] - counts[1], counts[1] - counts[2]
        usable = np.minimum(late, early) >= PRESENT * m
        means = [(a - b)[:, usable] / n[usable] for a, b, n in ((sums[0], sums[1], late), (sums[1], sums[2], early))]
        return m * (means[0] - means[1])

    def _shorten(self):
        """Keep what later differences need, counted from the first sample kept; drop earlier holes."""
        if self.sums.shape[1] <= self.reach + 1:
            return
        self.sums = self.sums[:, -self.reach - 1:]
        self.sums = self.sums - self.sums[:, :1]
        if self.counts is not None:
            self.counts = self.counts[-self.reach - 1:] - self.counts[-self.reach - 1]
            if self.counts[-1] == self.reach:
                self.counts = None


def overlapping_allan_variance(values: np.ndarray, factors: np.ndarray) -> np.ndarray:
    """
    Return the overlapping Allan variance of samples in memory, shape (n_scales, n_columns).

    Parameters
    ----------
    values : ndarray, shape (n, n_columns)
        Readings at equal steps of time.
    factors : ndarray of int, shape (n_scales,)
        Samples per mean.

    """
    sums = AllanSums(factors, np.shape(values)[1])
    for start in range(0, len(values), 65536):
        sums.push(np.asarray(values[start:start + 65536], float))
    sums.end_stretch()
    return sums.variance()
