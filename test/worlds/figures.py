"""Print a measured figure beside its target, so that `pytest -s` or `-rP` reads as a table."""

import numpy as np


def show(target, name, measured, wanted):
    """Print one line: target, what was measured, the figure, what was wanted."""
    text = np.array2string(np.asarray(measured), precision=5, max_line_width=200)
    print(f'{target:<4} {name:<58} {text:<24} wanted {wanted}')
