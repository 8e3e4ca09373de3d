"""A column group: functions of the true motion that effects multiply with their coefficients, declared as text."""

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.effects.expressions import PLACES, QUANTITY_OF, Sum, array_function, may_fail, names_in, products, read
from imu_calibration.kinematics.reference_motion import Reference

STEP = 1e-30
"""Complex step of the derivative by a time constant."""


@dataclass(frozen=True)
class ColumnGroup:
    """
    Columns that belong together, by one text for each.

    The texts (`effects.expressions`) define them completely: arrays of columns, the compensation of a sample and the data
    that the columns need are derived from them. A group with a time constant `tau` has each column and its derivative by `tau`.
    """

    name: str
    """Effects of one sensor that name the same group share its columns."""
    text: tuple
    """One expression for each column."""
    owner: str = ''
    """The effect whose last value is `tau`, where the text contains it."""

    def __reduce__(self):
        """Pickle without cached values: code cannot be pickled."""
        return ColumnGroup, tuple(getattr(self, f.name) for f in fields(self))

    @cached_property
    def _trees(self):
        return [read(text) for text in self.text]

    @cached_property
    def names(self) -> frozenset[str]:
        """Names of `expressions.PLACES` in the texts."""
        return frozenset().union(*map(names_in, self._trees))

    @cached_property
    def uses(self) -> frozenset[str]:
        """Quantities of `expressions.QUANTITIES` that the columns are made of."""
        return frozenset(QUANTITY_OF[name] for name in self.names)

    @cached_property
    def width(self) -> int:
        """Number of columns."""
        return len(self.text) * (2 if 'tau' in self.names else 1)

    @cached_property
    def _function(self):
        return array_function(self._trees)

    @cached_property
    def _may_fail(self):
        return any(map(may_fail, self._trees))

    @cached_property
    def _places(self):
        return [(name, field, (slice(None), *index)) for name in sorted(self.names) for field, *index in [PLACES[name]] if field]

    def columns(self, ref: Reference, point: dict[str, Any]) -> np.ndarray:
        """
        Return the columns, shape (n, width).

        Parameters
        ----------
        ref : Reference
            The true motion.
        point : dict
            'temperature_ref_c', effect name -> values where columns depend on them, 'centre': group -> value to subtract
            (``SensorModel.full_point``).

        Raises
        ------
        InputError
            When a column is not finite everywhere.

        """
        try:
            values = {name: getattr(ref, field)[index] for name, field, index in self._places}
        except IndexError as error:
            raise InputError(f"the columns of '{self.name}' refer to more joints than exist: {', '.join(self.text)}; "
                             "correct them") from error
        values['temperature_ref_c'] = np.float64(point.get('temperature_ref_c', 25.0))
        result, count = np.empty((len(ref), self.width)), len(self.text)
        if 'tau' in self.names:
            values['tau'] = point[self.owner][-1] + 1j * STEP
        with np.errstate(all='ignore'):
            for k, column in enumerate(self._function(values)):
                result[:, k] = np.real(column)
                if self.width > count:
                    result[:, count + k] = np.imag(column) / STEP
        if self.name in point.get('centre', ()):
            result -= point['centre'][self.name]
        if self._may_fail and not np.all(np.isfinite(result)):
            raise InputError(f"the columns of '{self.name}' must be finite in the whole recording, {', '.join(self.text)} is not; "
                             "do not divide by a quantity that "
                             'passes through zero, and use no root or logarithm of a negative quantity', code='column_not_finite')
        return result

    def products(self, known: dict[str, Sum]) -> list[Sum]:
        """Return each column as a sum of products (`expressions.products`)."""
        return [products(tree, known) for tree in self._trees]
