"""The canvas of figures that are painted and not laid out."""


class BlankCanvas:
    """Stands for the canvas of a figure that nobody looks at."""

    def print_svg(self, text, metadata):
        text.write('<svg viewBox="0 0 1 1"></svg>')
