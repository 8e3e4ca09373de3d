"""The grammar of formulas: which columns are tried where the catalogue has none, as texts that a user effect can hold."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations, combinations_with_replacement, product

from imu_calibration.effects.base import AXES
from imu_calibration.effects.expressions import FUNCTIONS, QUANTITY_OF, names_in, read

ORDERS, PAIR_ORDERS, FEW_ORDERS = range(1, 9), range(1, 7), range(1, 4)
"""Harmonics per turn: of one joint, of two joints at once, of a joint times another quantity."""
CONSTANTS = (0.07, 0.2, 0.6)
"""Time constants of settling, as shares of the recording."""
SOFT_SIGN = 'tanh({} / 0.005)'
"""The sense of a rate changes over 0.3 deg/s: at rest a sign is that of the Earth's rate or of noise, and would shake the bias there."""
WARMTH = '(temperature_c - temperature_ref_c)'
UNIT_OF = {'force': 'm/s^2', 'rate': 'rad/s', 'angular acceleration': 'rad/s^2', 'temperature': 'K', 'joint rate': 'rad/s', 'time': 's'}
"""Quantity -> unit of one factor of it; angles, attitudes and arguments of functions have none."""


@dataclass(frozen=True)
class Formula:
    """Columns that are tried together: with one amplitude for each column and axis."""

    columns: tuple
    """Texts: each a str for all axes, or three, one for each axis."""
    factors: tuple
    """Quantities that a column is the product of, with repetition; its unit follows."""
    phased: str = ''
    """The same with a phase, where the columns are the cosine and the sine of one angle: text with {phase}."""

    @property
    def family(self) -> frozenset[str]:
        """Quantities in it."""
        texts = [text for column in self.columns for text in ((column,) if isinstance(column, str) else column)]
        return frozenset(QUANTITY_OF[name] for text in texts for name in names_in(read(text))) - {'reference temperature'}

    @property
    def smooth(self) -> bool:
        """Whether it changes slowly, as every bias does."""
        return self.family <= {'time', 'temperature'}

    @property
    def complexity(self) -> tuple[int, int]:
        """Measure of complexity: columns; factors and functions."""
        text = str(self.columns[0])
        return len(self.columns), len(self.factors) + sum(text.count(f'{name}(') for name in FUNCTIONS)

    def unit(self, output: str) -> str:
        """Return the unit of an amplitude, with `output` that of the sensor."""
        per: dict[str, int] = {}
        for factor in self.factors:
            if factor in UNIT_OF:
                per[UNIT_OF[factor]] = per.get(UNIT_OF[factor], 0) + 1
        return output + ''.join(f'/{_bracketed(unit)}{"" if power == 1 else f"^{power}"}' for unit, power in per.items())


def _bracketed(unit):
    return f'({unit})' if '/' in unit else unit


@lru_cache(maxsize=16)
def grammar(n_joints: int, thermal: bool, duration: float) -> tuple[Formula, ...]:
    """
    Return the formulas that are tried.

    Products of up to three of specific force and rate; angular acceleration, magnitudes and signs with one more factor; all of these times
    the temperature and times settling; harmonics of one joint, of two joints, times the joint's rate, the temperature, or the sensor's
    input; and vectors fixed to the table while the sensor turns.

    Parameters
    ----------
    n_joints : int
        Joints of the table.
    thermal : bool
        Whether a temperature was recorded.
    duration : float
        Length of the recording, s, to two digits: texts hold time constants.

    """
    found = [Formula((text,), factors) for text, factors in (*_of_motion(), *_slow(thermal, duration))]
    found += [*_harmonics(n_joints, thermal), *_of_joint_rates(n_joints), *_with_the_table(n_joints, thermal)]
    return tuple(found)


def _atoms(*letters):
    kinds = {'f': 'force', 'w': 'rate', 'alpha': 'angular acceleration'}
    return [(f'{letter}_{a}', (kinds[letter],)) for letter in letters for a in AXES]


def _sense(text):
    return SOFT_SIGN.format(text) if text.startswith('w') else f'sign({text})'


def _times(*parts):
    """Return (text, factors) of a product, powers gathered."""
    texts, factors = [text for text, _ in parts], tuple(factor for _, own in parts for factor in own)
    powers = {text: texts.count(text) for text in texts}
    return ' * '.join(text if power == 1 else f'{text} ** {power}' for text, power in powers.items()), factors


def _monomials(degree):
    return [_times(*parts) for parts in combinations_with_replacement(_atoms('f', 'w'), degree)]


def _of_motion() -> Iterator:
    felt = _atoms('f', 'w')
    yield from (entry for degree in (1, 2, 3) for entry in _monomials(degree))
    yield from _atoms('alpha')
    yield from (_times(*pair) for pair in product(_atoms('alpha'), felt))
    for text, own in felt:
        for part in ((f'abs({text})', own), (_sense(text), ())):
            yield part
            yield from (_times(part, other) for other in felt if other[0] != text or part[1])
    for letter, name in (('f', 'force'), ('w', 'rate')):
        yield ' + '.join(f'{letter}_{a} ** 2' for a in AXES), (name, name)
        yield 'sqrt(' + ' + '.join(f'{letter}_{a} ** 2' for a in AXES) + ')', (name,)


def _slow(thermal: bool, duration: float) -> Iterator:
    warm = [(WARMTH, ('temperature',))] if thermal else []
    settles = [(f'(1 - exp(-time / {share * duration:.3g}))', ()) for share in CONSTANTS] + [('time', ('time',))]
    yield from ((f'{WARMTH} ** {power}', ('temperature',) * power) for power in (2, 3) if thermal)
    for slow in (*warm, *settles):
        yield from (_times(slow, entry) for degree in (1, 2) for entry in _monomials(degree))
        for text, own in _atoms('f', 'w'):
            yield _times(slow, (f'abs({text})', own))
            yield _times(slow, (_sense(text), ()))
    yield from (_times(*warm, *warm, entry) for entry in _monomials(1) if thermal)


def _turn(joint, order, before=''):
    """Return (cosine, sine, text with a phase) of an order of a joint."""
    inside = f'angle_{joint}' if order == 1 else f'{order} * angle_{joint}'
    return f'{before}cos({inside})', f'{before}sin({inside})', f'{before}cos({inside} - {{phase}})'


def _harmonics(n_joints, thermal):
    joints = range(1, n_joints + 1)
    for joint, order in product(joints, ORDERS):
        befores = [('', ()), (f'joint_rate_{joint} * ', ('joint rate',))] + [(f'{WARMTH} * ', ('temperature',))] * thermal
        if order in FEW_ORDERS:
            befores += [(f'{text} * ', own) for text, own in _atoms('f', 'w')]
        for before, factors in befores:
            cosine, sine, phased = _turn(joint, order, before)
            yield Formula((cosine, sine), factors, phased)
    for (first, second), orders in product(combinations(joints, 2), product(PAIR_ORDERS, PAIR_ORDERS)):
        halves = [_turn(joint, order)[:2] for joint, order in zip((first, second), orders)]
        yield Formula(tuple(f'{a} * {b}' for a, b in product(*halves)), ())


def _of_joint_rates(n_joints):
    rates = [(f'joint_rate_{joint}', ('joint rate',)) for joint in range(1, n_joints + 1)]
    for text, own in rates:
        yield Formula((f'abs({text})',), own)
        yield Formula((SOFT_SIGN.format(text),), ())
        yield Formula((f'{text} * abs({text})',), own * 2)
    yield from (Formula((text,), own) for degree in (1, 2)
                for text, own in (_times(*p) for p in combinations_with_replacement(rates, degree)))


def _with_the_table(n_joints, thermal):
    """Yield vectors fixed to the level frame while the sensor turns."""
    joints = range(1, n_joints + 1)
    vectors = [[f'c_{axis}{level}' for axis in AXES] for level in AXES]
    befores = [('', ())] + [(f'{WARMTH} * ', ('temperature',))] * thermal
    befores += [(f'joint_rate_{joint} * ', ('joint rate',)) for joint in joints]
    for before, factors in befores:
        yield Formula(tuple(tuple(before + text for text in vector) for vector in vectors), factors)
    for vector, joint, order in product(vectors, joints, FEW_ORDERS):
        yield Formula(tuple(tuple(f'{wave} * {text}' for text in vector) for wave in _turn(joint, order)[:2]), ())
