"""Figures without a screen."""


def new_figure(rows, columns, size):
    """Return (figure, axes) of a size in inches."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout='constrained')
    return figure, figure.subplots(rows, columns)
