"""A figure that a notebook shows and a file can contain."""

from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

from imu_calibration.document import files
from imu_calibration.report.figures import Drawn


@dataclass(frozen=True)
class Drawing:
    """A figure as SVG, PDF, matplotlib axes and arrays."""

    svg: Drawn
    """The svg element."""

    @property
    def axes(self) -> list[Any]:
        """The matplotlib axes; ``axes[0].figure`` is the figure."""
        return self.svg.figure.axes

    @property
    def data(self) -> list[dict[str, Any]]:
        """The content of the axes as arrays, as `Drawn.data`."""
        return self.svg.data

    def _repr_html_(self) -> str:
        return f'<div style="max-width:860px">{self.svg}</div>'

    def save(self, path: str | PathLike) -> None:
        """Write the figure: as PDF if the name ends with .pdf, otherwise as SVG."""
        if Path(path).suffix.lower() == '.pdf':
            files.write_whole(path, self.svg.pdf)
        else:
            files.write_text(path, str(self.svg))
