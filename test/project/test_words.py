"""Names in the glossary exist in the code."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
CODE = {
    path: path.read_text()
    for folder in ('imu_calibration', 'msg_adapters')
    for path in sorted((ROOT / folder).rglob('*'))
    if path.suffix in ('.py', '.html')
}
ROWS = re.findall(
    r'^\| (?!ours|---)(.+?) \| (.+?) \| (.+?) \|$',
    (ROOT / 'docs/glossary.md').read_text(),
    flags=re.M,
)


def test_the_glossary_gives_the_fields_term_beside_ours():
    assert (
        ROWS
        and [ours for ours, field, meaning in ROWS if len(field) < 3 or len(meaning) < 20] == []
    )


@pytest.mark.parametrize(
    'name',
    sorted({name for row in ROWS for cell in row for name in re.findall(r'`([^`]+)`', cell)}),
)
def test_what_it_names_is_in_the_code(name):
    if name.endswith('.py'):
        assert any(path.as_posix().endswith(name) for path in CODE)
    else:
        assert any(name in text for text in CODE.values())
