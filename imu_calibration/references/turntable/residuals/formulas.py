"""Formulas of the motion, the temperature and the time for a residual, and their search."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations, combinations_with_replacement, product

import numpy as np
from scipy.linalg import svd

from imu_calibration.core.distributions import chi2_sf
from imu_calibration.effects.base import AXES, TEMPERATURE_RISE
from imu_calibration.effects.expressions import (
    FUNCTIONS,
    PLACES,
    QUANTITY_OF,
    array_function,
    names_in,
    read,
)
from imu_calibration.references.turntable.residuals.residual_blocks import SELECTION, BlockMeans
from imu_calibration.selection.search import FAMILY_WISE, TIE

JOINT_ORDERS = range(1, 9)
"""Harmonics per turn of one joint."""
PAIR_ORDERS = range(1, 7)
"""Harmonics per turn of each of two joints in a product."""
FEW_ORDERS = range(1, 4)
"""Harmonics per turn of a joint in a product with another quantity."""
TIME_CONSTANT_SHARES = (0.07, 0.2, 0.6)
"""Time constants of settling, as shares of the duration."""
SOFT_SIGN = 'tanh({} / 0.005)'
"""
Smooth sign of a rate, which changes over 0.3 deg/s: at rest the sign would be that of the Earth's
rate or of noise.
"""
TEMPERATURE_FACTOR = f'({TEMPERATURE_RISE})'
"""Text of the temperature above its reference."""
UNIT_OF = {
    'force': 'm/s^2',
    'rate': 'rad/s',
    'angular acceleration': 'rad/s^2',
    'temperature': 'K',
    'temperature rate': 'K/s',
    'joint rate': 'rad/s',
    'time': 's',
}
"""Quantity -> unit of one factor of it; angles, attitudes and arguments of functions have none."""
Column = str | tuple[str, ...]
"""Text of a column for all axes, or of three, one for each axis."""


@dataclass(frozen=True)
class Product:
    """A product of quantities."""

    text: str
    """Text of the product."""
    factors: tuple[str, ...] = ()
    """Quantities that it is the product of, with repetition; functions have none."""

    @property
    def as_factor(self) -> str:
        """The text in front of another factor; empty for the empty product."""
        return f'{self.text} * ' if self.text else ''


@dataclass(frozen=True)
class Formula:
    """Columns that are tried together: with one amplitude for each column and axis."""

    columns: tuple[Column, ...]
    """Texts of the columns."""
    factors: tuple[str, ...]
    """Quantities that a column is the product of, with repetition, which give its unit."""
    phased: str = ''
    """
    Text with {phase} of the sum of both columns, where they are the cosine and the sine of one
    angle.
    """

    @property
    def family(self) -> frozenset[str]:
        """Quantities in the columns."""
        quantities = set()
        for column in self.columns:
            for text in (column,) if isinstance(column, str) else column:
                for name in names_in(read(text)):
                    quantities.add(QUANTITY_OF[name])
        return frozenset(quantities) - {'reference temperature'}

    @property
    def smooth(self) -> bool:
        """Whether it changes slowly, as every bias does."""
        return self.family <= {'time', 'temperature', 'temperature rate'}

    @property
    def complexity(self) -> tuple[int, int]:
        """(number of columns, number of factors and functions)."""
        text = str(self.columns[0])
        n_functions = sum(text.count(f'{name}(') for name in FUNCTIONS)
        return len(self.columns), len(self.factors) + n_functions

    def unit(self, output: str) -> str:
        """Return the unit of an amplitude: that of the `output` over those of the factors."""
        powers = Counter(UNIT_OF[factor] for factor in self.factors if factor in UNIT_OF)
        text = output
        for unit, power in powers.items():
            text += f'/({unit})' if '/' in unit else f'/{unit}'
            if power > 1:
                text += f'^{power}'
        return text


@lru_cache(maxsize=16)
def grammar(n_joints: int, thermal: bool, duration: float) -> tuple[Formula, ...]:
    """
    Return the formulas that are tried.

    Products of up to three of specific force and rate; angular acceleration, magnitudes and signs
    with one more factor; all of these times the temperature and times settling; harmonics of one
    joint, of two joints, times the joint's rate, the temperature, or the sensor's input; and
    vectors fixed to the table while the sensor turns.

    Parameters
    ----------
    n_joints : int
        Joints of the table.
    thermal : bool
        Whether a temperature was recorded.
    duration : float
        Length of the recording, s, to two digits: texts hold time constants.

    """
    products = (*_of_motion(), *_slow(thermal, duration))
    return (
        *(Formula((entry.text,), entry.factors) for entry in products),
        *_harmonics(n_joints, thermal),
        *_of_joint_rates(n_joints),
        *_with_the_table(n_joints, thermal),
    )


def _atoms(*letters: str) -> list[Product]:
    """Return the components of the motion: of force (f), rate (w), angular acceleration (alpha)."""
    quantities = {'f': 'force', 'w': 'rate', 'alpha': 'angular acceleration'}
    atoms = []
    for letter in letters:
        for axis in AXES:
            atoms.append(Product(f'{letter}_{axis}', (quantities[letter],)))
    return atoms


def _sense(text: str) -> str:
    """Return the text of the sign of a component of force or rate; that of a rate is smooth."""
    return SOFT_SIGN.format(text) if text.startswith('w') else f'sign({text})'


def _times(*parts: Product) -> Product:
    """Return a product, with equal factors as a power: f_x, f_x, w_y gives f_x ** 2 * w_y."""
    powers: dict[str, int] = {}
    factors: tuple[str, ...] = ()
    for part in parts:
        powers[part.text] = powers.get(part.text, 0) + 1
        factors += part.factors
    texts = [text if power == 1 else f'{text} ** {power}' for text, power in powers.items()]
    return Product(' * '.join(texts), factors)


def _monomials(degree: int) -> list[Product]:
    """Return the products of `degree` components of force and rate."""
    return [_times(*parts) for parts in combinations_with_replacement(_atoms('f', 'w'), degree)]


def _of_motion() -> Iterator[Product]:
    """Yield the formulas of force, rate and angular acceleration."""
    components = _atoms('f', 'w')
    for degree in (1, 2, 3):
        yield from _monomials(degree)
    yield from _atoms('alpha')
    for pair in product(_atoms('alpha'), components):
        yield _times(*pair)

    # Magnitude and sign, single and with one more factor; the sign times its own quantity is the
    # magnitude.
    for quantity in components:
        magnitude = Product(f'abs({quantity.text})', quantity.factors)
        yield magnitude
        for component in components:
            yield _times(magnitude, component)
        sign = Product(_sense(quantity.text))
        yield sign
        for component in components:
            if component is not quantity:
                yield _times(sign, component)

    for letter, name in (('f', 'force'), ('w', 'rate')):
        squares = ' + '.join(f'{letter}_{axis} ** 2' for axis in AXES)
        yield Product(squares, (name, name))
        yield Product(f'sqrt({squares})', (name,))


def _slow(thermal: bool, duration: float) -> Iterator[Product]:
    """Yield the formulas of temperature or time, and their products with motion."""
    warm = Product(TEMPERATURE_FACTOR, ('temperature',))
    slow: list[Product] = []
    if thermal:
        yield Product('temperature_rate', ('temperature rate',))
        for power in (2, 3):
            yield Product(f'{TEMPERATURE_FACTOR} ** {power}', ('temperature',) * power)
        slow.append(warm)
    for share in TIME_CONSTANT_SHARES:
        slow.append(Product(f'(1 - exp(-time / {share * duration:.3g}))'))
    slow.append(Product('time', ('time',)))

    for factor in slow:
        for entry in (*_monomials(1), *_monomials(2)):
            yield _times(factor, entry)
        for quantity in _atoms('f', 'w'):
            yield _times(factor, Product(f'abs({quantity.text})', quantity.factors))
            yield _times(factor, Product(_sense(quantity.text)))
    if thermal:
        for entry in _monomials(1):
            yield _times(warm, warm, entry)


def _turn(joint: int, order: int, factor: str = '') -> tuple[str, str, str]:
    """
    Return (cosine, sine, cosine with a phase) of an order of a joint's angle, as texts.

    All are multiplied with a `factor`, a text that ends in ``*`` or is empty.
    """
    angle = f'angle_{joint}' if order == 1 else f'{order} * angle_{joint}'
    return f'{factor}cos({angle})', f'{factor}sin({angle})', f'{factor}cos({angle} - {{phase}})'


def _harmonics(n_joints: int, thermal: bool) -> Iterator[Formula]:
    """Yield cosines and sines of the angle of a joint, with other factors and of two joints."""
    joints = range(1, n_joints + 1)
    for joint, order in product(joints, JOINT_ORDERS):
        yield _harmonic(joint, order)
        yield _harmonic(joint, order, Product(f'joint_rate_{joint}', ('joint rate',)))
        if thermal:
            yield _harmonic(joint, order, Product(TEMPERATURE_FACTOR, ('temperature',)))
        if order in FEW_ORDERS:
            for quantity in _atoms('f', 'w'):
                yield _harmonic(joint, order, quantity)

    # cos a cos b, cos a sin b, sin a cos b, sin a sin b: any phase of both.
    for first, second in combinations(joints, 2):
        for first_order, second_order in product(PAIR_ORDERS, PAIR_ORDERS):
            of_first = _turn(first, first_order)[:2]
            of_second = _turn(second, second_order)[:2]
            yield Formula(tuple(f'{a} * {b}' for a, b in product(of_first, of_second)), ())


def _harmonic(joint: int, order: int, factor: Product = Product('')) -> Formula:
    """Return cosine and sine of an order of a joint, times a factor."""
    cosine, sine, phased = _turn(joint, order, factor.as_factor)
    return Formula((cosine, sine), factor.factors, phased)


def _of_joint_rates(n_joints: int) -> Iterator[Formula]:
    """Yield magnitude, sign, signed square of a joint's rate, and products of up to two rates."""
    joints = range(1, n_joints + 1)
    rates = [Product(f'joint_rate_{joint}', ('joint rate',)) for joint in joints]
    for rate in rates:
        yield Formula((f'abs({rate.text})',), rate.factors)
        yield Formula((SOFT_SIGN.format(rate.text),), ())
        yield Formula((f'{rate.text} * abs({rate.text})',), rate.factors * 2)
    for degree in (1, 2):
        for parts in combinations_with_replacement(rates, degree):
            rates_together = _times(*parts)
            yield Formula((rates_together.text,), rates_together.factors)


def _with_the_table(n_joints: int, thermal: bool) -> Iterator[Formula]:
    """Yield vectors fixed to the level frame while the sensor turns."""
    joints = range(1, n_joints + 1)
    # The components of a level axis along the axes of the sensor: elements of the attitude.
    vectors = [[f'c_{axis}{level}' for axis in AXES] for level in AXES]
    factors = [Product('')]
    if thermal:
        factors.append(Product(TEMPERATURE_FACTOR, ('temperature',)))
    for joint in joints:
        factors.append(Product(f'joint_rate_{joint}', ('joint rate',)))
    for factor in factors:
        columns = tuple(_each_times(factor.as_factor, vector) for vector in vectors)
        yield Formula(columns, factor.factors)
    for vector, joint, order in product(vectors, joints, FEW_ORDERS):
        cosine, sine, _ = _turn(joint, order)
        columns = (_each_times(f'{cosine} * ', vector), _each_times(f'{sine} * ', vector))
        yield Formula(columns, ())


def _each_times(prefix: str, vector: Sequence[str]) -> tuple[str, ...]:
    """Return the texts of a vector, each after the text of a factor."""
    return tuple(prefix + text for text in vector)


NEW = 1e-3
"""
Least norm of a tested column outside the span of the catalogue, over the norm of the column.
"""
COLUMN_CHUNK = 128
"""Columns that are evaluated at once."""


@dataclass(frozen=True, eq=False)
class FormulaChoice:
    """One formula with its evidence."""

    formula: Formula
    """The candidate."""
    columns: np.ndarray
    """Means over the blocks, shape (b, k, 3): of k columns, for each axis."""
    p_value: float
    """Probability of such a fall of the misfit by noise, times the number of formulas."""
    alike: tuple[Formula, ...]
    """Formulas with nearly the same evidence, the likeliest first."""


@lru_cache(maxsize=64)
def _function(texts: Iterable[str]) -> Callable:
    """Return the function that evaluates some texts together (`array_function`)."""
    return array_function([read(text) for text in texts])


@dataclass(frozen=True, eq=False)
class _OutsideCatalogue:
    """Whitened residual and columns of one axis, without what the catalogue explains of them."""

    residual: np.ndarray
    """Shape (n,)."""
    columns: np.ndarray
    """Shape (n, n_texts); zero for a column that the catalogue contains."""
    n_explained: int
    """Number of directions in which the catalogue may exceed the noise, and of projected ones."""

    @classmethod
    def of(
        cls, contributions: np.ndarray, residual: np.ndarray, columns: np.ndarray
    ) -> '_OutsideCatalogue':
        """
        Return the residual and the columns with the catalogue's contributions as further noise.

        Plausible contributions A p of covariance ``cov(p) = P P'`` add to noise of unit variance.
        With ``A P = U S V'`` the rows are whitened by the factor::

            (1 + U S^2 U')^(-1/2) = 1 - U diag(1 - 1 / sqrt(1 + S^2)) U'

        Parameters
        ----------
        contributions : ndarray, shape (n, q)
            ``A P``.
        residual : ndarray, shape (n,)
        columns : ndarray, shape (n, n_texts)

        """
        basis, sizes, _ = svd(contributions, full_matrices=False, lapack_driver='gesdd')
        damped = 1.0 - 1.0 / np.sqrt(1.0 + sizes**2)
        free_residual = residual - basis @ (damped * (basis.T @ residual))
        free = columns - basis @ (damped[:, None] * (basis.T @ columns))

        # A column that the catalogue contains is no formula beyond it.
        square = np.einsum('bt,bt->t', columns, columns)
        free_square = np.einsum('bt,bt->t', free, free)
        is_new = free_square > NEW**2 * np.maximum(square, 1e-300)
        return cls(free_residual, np.where(is_new, free, 0.0), int((sizes > 1.0).sum()))


class FormulaSearch:
    """
    Search of formulas for the residual of one sensor, in the blocks outside locked windows.

    Contributions of the model and of the catalogue of plausible size are projected out.

    Parameters
    ----------
    blocks : BlockMeans
    formulas : sequence of Formula
        Candidates.
    plausible : array, shape (q, q)
        Factor P of the plausible covariance ``P P'`` of the parameters of the space.
    reference_temperature : float
        Of the temperature factor, degrees Celsius.

    """

    def __init__(
        self,
        blocks: BlockMeans,
        formulas: Sequence[Formula],
        plausible: np.ndarray,
        *,
        reference_temperature: float,
    ):
        self.blocks = blocks
        self.formulas = formulas
        # Text -> its place among the columns; many formulas have the same texts.
        self._place: dict[str, int] = {}
        for formula in formulas:
            for column in formula.columns:
                for text in _three(column):
                    self._place.setdefault(text, len(self._place))
        # Means over the blocks of the column of each text, shape (b, n_texts).
        self.means = self._evaluated(tuple(self._place), reference_temperature)

        # Whitened rows: the catalogue's columns and the residual of each axis, then the texts.
        whitener = blocks.white[SELECTION]
        white = whitener.whiten(np.concatenate([*blocks.design, self.means], axis=1))
        ends = np.cumsum([0, *(part.shape[1] for part in blocks.design)])
        self._axes: list[_OutsideCatalogue] = []
        for axis in range(3):
            rows = white[:, ends[axis] : ends[axis + 1]] / whitener.scale[axis]
            outside = _OutsideCatalogue.of(
                contributions=rows[:, :-1] @ plausible[blocks.index[axis]],
                residual=rows[:, -1],
                columns=white[:, ends[3] :] / whitener.scale[axis],
            )
            self._axes.append(outside)

    def _evaluated(self, texts: Sequence[str], reference_temperature: float) -> np.ndarray:
        """Return the means over the blocks of texts, shape (b, n_texts); 0 where not finite."""
        # Name of a quantity -> its value at each row: a field of the motion, or a part of it with
        # the indices behind the rows, as (attitude, 0, 2).
        ref = self.blocks.ref
        quantities = {'temperature_ref_c': reference_temperature}
        for name, (attribute, *index) in PLACES.items():
            if not attribute:  # a constant
                continue
            values = getattr(ref, attribute)
            # Neither a missing temperature nor a joint that the table does not have.
            if values is not None and (not index or index[-1] < values.shape[-1]):
                at_all_rows = (slice(None), *index)
                quantities[name] = values[at_all_rows]

        # Some texts at a time. A constant text has one value for all rows.
        means = np.empty((len(self.blocks.time), len(texts)))
        with np.errstate(all='ignore'):
            for first in range(0, len(texts), COLUMN_CHUNK):
                values_of_texts = _function(texts[first : first + COLUMN_CHUNK])(quantities)
                columns = []
                for values in values_of_texts:
                    columns.append(np.broadcast_to(np.asarray(values, float), len(ref)))
                last = first + len(columns)
                means[:, first:last] = self.blocks.means(np.stack(columns, axis=1))
        return np.nan_to_num(means, nan=0.0, posinf=0.0, neginf=0.0)

    def best(self) -> FormulaChoice | None:
        """
        Return the simplest of the likeliest formulas, or None where none is significant.

        The likeliest formula has the largest ``fall of chi-square - 2 n_amplitudes``. Formulas with
        nearly the same value, within `TIE` in units of the remaining misfit, are as likely.
        """
        # Is the likeliest significant among so many?
        falls, n_amplitudes = self._falls()
        price = 2.0 * n_amplitudes
        order = np.argsort(price - falls)
        likeliest = order[0]
        by_noise = float(chi2_sf(falls[likeliest], max(n_amplitudes[likeliest], 1)))
        p_value = min(1.0, by_noise * len(self.formulas))
        if p_value > FAMILY_WISE or falls[likeliest] <= price[likeliest]:
            return None

        # Chi-square per degree of freedom with the likeliest formula, at least 1.
        dof = max(sum(len(rows.residual) - rows.n_explained for rows in self._axes), 1)
        squares = sum(float(rows.residual @ rows.residual) for rows in self._axes)
        misfit = max((squares - falls[likeliest]) / dof, 1.0)

        # Formulas that are as likely, among the first 200.
        advantage = falls - price
        as_likely = []
        for k in order[:200]:
            if advantage[likeliest] - advantage[k] < 2 * TIE * misfit and n_amplitudes[k]:
                as_likely.append(k)
        simplest = min(as_likely, key=lambda k: (self.formulas[k].complexity, price[k] - falls[k]))
        formula = self.formulas[simplest]
        return FormulaChoice(
            formula,
            np.stack([self.means[:, self._places(column)] for column in formula.columns], axis=1),
            p_value,
            tuple(self.formulas[k] for k in as_likely if k != simplest),
        )

    def project_out(self, choice: FormulaChoice) -> None:
        """Project a choice out, so that the next is tested conditional on it."""
        # x - U U' x is orthogonal to the columns of the choice; U is their basis, without
        # directions of collinear columns.
        for axis, rows in enumerate(self._axes):
            places = [self._places(column)[axis] for column in choice.formula.columns]
            basis, sizes, _ = svd(rows.columns[:, places], full_matrices=False)
            basis = basis[:, sizes > 1e-9 * max(sizes.max(), 1e-300)]
            self._axes[axis] = _OutsideCatalogue(
                rows.residual - basis @ (basis.T @ rows.residual),
                rows.columns - basis @ (basis.T @ rows.columns),
                rows.n_explained + basis.shape[1],
            )

    def _places(self, column: Column) -> list[int]:
        """Return the places of the texts of a column for the three axes."""
        return [self._place[text] for text in _three(column)]

    def _falls(self) -> tuple[np.ndarray, np.ndarray]:
        """
        Return (fall of chi-square, number of amplitudes) of each of n formulas, shape (n,) both.

        With the columns X of a formula, scaled to unit length, and the residual r of an axis::

            fall = (X'r)' (X'X)^-1 (X'r)

        """
        falls = np.zeros(len(self.formulas))
        n_amplitudes = np.zeros(len(self.formulas))
        # All formulas with the same number of columns at once.
        for width in {len(formula.columns) for formula in self.formulas}:
            chosen = [k for k, formula in enumerate(self.formulas) if len(formula.columns) == width]
            places = []
            for k in chosen:
                places.append([self._places(column) for column in self.formulas[k].columns])
            place_on_axes = np.array(places)  # (n_chosen, width, 3)
            for axis, rows in enumerate(self._axes):
                # X'r of every text, with its column at unit length.
                places_of_axis = place_on_axes[:, :, axis]
                free = rows.columns
                size = np.sqrt(np.maximum(np.einsum('bt,bt->t', free, free), 1e-300))
                slopes = (free.T @ rows.residual) / size

                # X'X of each formula: cosines of the angles between its columns.
                gram = np.eye(width) * np.ones((len(chosen), 1, 1))
                for i in range(width):
                    for j in range(i):
                        first = places_of_axis[:, i]
                        second = places_of_axis[:, j]
                        inner = np.einsum('bg,bg->g', free[:, first], free[:, second])
                        cosine = np.clip(inner / (size[first] * size[second]), -1.0, 1.0)
                        gram[:, i, j] = cosine
                        gram[:, j, i] = cosine
                gram += 1e-6 * np.eye(width)  # so that collinear columns have a solution
                right = slopes[places_of_axis]
                amplitudes = np.linalg.solve(gram, right[..., None])[..., 0]
                falls[chosen] += np.einsum('gk,gk->g', right, amplitudes)

                # Columns that the catalogue contains are zero, and have no amplitude.
                n_amplitudes[chosen] += (size[places_of_axis] > 1e-100).sum(axis=1)
        return falls, n_amplitudes


def _three(column: Column) -> tuple[str, ...]:
    """Return the text of a column for each axis."""
    return (column,) * 3 if isinstance(column, str) else column
