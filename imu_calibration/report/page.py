"""Templates to HTML: one file, no outside resources, the same input gives the same bytes."""

from typing import Any


def render(template: str, **content: Any) -> str:
    """Return the HTML of one of the package's templates."""
    from jinja2 import Environment, PackageLoader, StrictUndefined
    environment = Environment(loader=PackageLoader('imu_calibration.report', 'templates'), autoescape=True, undefined=StrictUndefined,
                              trim_blocks=True, lstrip_blocks=True)
    return environment.get_template(template).render(**content)
