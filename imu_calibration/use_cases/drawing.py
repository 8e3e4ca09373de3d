"""A figure that a notebook shows and a file can hold."""

from dataclasses import dataclass
from os import PathLike

from imu_calibration import files


@dataclass(frozen=True)
class Drawing:
    """A figure as SVG."""

    svg: str
    """The svg element."""

    def _repr_html_(self) -> str:
        return f'<div style="max-width:860px">{self.svg}</div>'

    def save(self, path: str | PathLike) -> None:
        """Write the figure as an SVG file."""
        files.write_text(path, self.svg)
