"""
The report: true to the calibration, and complete without a network.

It has the same bytes each time, and is fit for a browser.
"""

import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from blank_canvas import BlankCanvas

from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.core.samples import SampleBlock
from imu_calibration.core.units import with_sd
from imu_calibration.effects.base import Role
from imu_calibration.effects.catalogue import CATALOGUE
from imu_calibration.effects.forward_equations import coefficients
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics import strapdown
from imu_calibration.references.turntable.accumulator import restrict
from imu_calibration.report import figures
from imu_calibration.report.calibration_sections import (
    autocorrelation,
    calibration_report,
    reading_tables,
    residual_figure,
)
from imu_calibration.report.navigation_section import (
    expected_growth,
    motion_growth,
    noise_densities,
)
from imu_calibration.report.page import fixed, number_text
from imu_calibration.simulation.profiles import make_profile
from imu_calibration.simulation.sensor_noise import GRADES
from imu_calibration.simulation.session import SimulationOptions, random_values, simulate_session

from worlds.calibrated import calibrated_by_hand, calibrated_on_table
from worlds.candidates import FEW
from worlds.tables import three_axis_table

TABLE = three_axis_table(height=150.0)
MODEL = SensorModel(accelerometer=('bias', 'matrix', 'accel_size_effect'))
OPTIONS = CalibrationOptions(catalogue=CATALOGUE.with_candidates('none'))
SEARCHING = CalibrationOptions(catalogue=CATALOGUE.with_candidates(FEW))
PROVENANCE = {'bags': [{'name': 'session <1>', 'sha256': '0123456789abcdef'}]}
SECTIONS = (
    'parameters',
    'apply',
    'derived',
    'residuals',
    'observability',
    'navigation',
    'readings',
    'budget',
    'origin',
)
VOID = {'meta', 'link', 'br', 'img', 'hr', 'input'}


def session(profile, seed=6):
    """Simulate one recording."""
    values = random_values(MODEL, 'industrial', seed)
    imu, joints, _ = simulate_session(
        MODEL,
        values,
        TABLE,
        profile=make_profile(profile, seed, TABLE),
        options=SimulationOptions(50.0, 50.0, GRADES['industrial'].noise),
        seed=seed,
    )
    return SampleBlock(imu, joints)


@pytest.fixture(scope='module')
def quick():
    """The recording of a short full session."""
    return session('quick')


@pytest.fixture(scope='module')
def on_table(quick):
    """Its calibration on the table."""
    return calibrated_on_table([[quick]], TABLE, OPTIONS, provenance=PROVENANCE)


@pytest.fixture(scope='module')
def by_hand(quick):
    """The same recording calibrated by hand."""
    return calibrated_by_hand([[SampleBlock(quick.imu)]], OPTIONS, provenance=PROVENANCE)


@pytest.fixture(scope='module')
def demanding(quick):
    """The recording judged by tolerances on the arms that it does not meet."""
    return calibrated_on_table(
        [[quick]],
        TABLE,
        replace(OPTIONS, tolerances={'accelerometer': {'accel_size_effect': 1e-5}}),
        provenance=PROVENANCE,
    )


def without_layout(result):
    """Return a report with figures that are painted and not laid out, which is half of its time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(figures, '_laid_out', lambda figure: BlankCanvas())
        return calibration_report(result)


@pytest.fixture(scope='module')
def pages(on_table, by_hand, demanding):
    """The three reports."""
    return {
        'on_table': calibration_report(on_table),
        'by_hand': calibration_report(by_hand),
        'demanding': without_layout(demanding),
    }


class Balance(HTMLParser):
    """Counts tags that do not close, and collects addresses."""

    def __init__(self):
        super().__init__()
        self.open, self.wrong, self.addresses = [], [], []

    def handle_starttag(self, tag, attributes):
        """Open a tag."""
        self.addresses += [
            value for name, value in attributes if name in ('src', 'href', 'xlink:href') and value
        ]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        """Note the addresses of a tag that closes itself."""
        self.addresses += [
            value for name, value in attributes if name in ('src', 'href', 'xlink:href') and value
        ]

    def handle_endtag(self, tag):
        """Close a tag."""
        if not self.open or self.open.pop() != tag:
            self.wrong.append(tag)


@pytest.mark.long
@pytest.mark.parametrize('name', ('on_table', 'by_hand', 'demanding'))
def test_the_page_is_whole_and_needs_nothing_else(pages, name):
    page = pages[name]
    parser = Balance()
    parser.feed(page)
    assert (parser.wrong, parser.open) == ([], [])
    assert [a for a in parser.addresses if not a.startswith(('#', 'data:'))] == []
    assert not re.search(r'<script|@import|url\((?!#)', page)
    assert [s for s in SECTIONS if f'<section id="{s}">' not in page] == []
    assert 'session &lt;1&gt;' in page and 'session <1>' not in page
    assert not re.search(
        r'\bnan\b|\binf\b|None|Undefined',
        re.sub(r'<svg.*?</svg>|<style>.*?</style>', '', page, flags=re.S).replace(
            'None: in every', ''
        ),
    )


def test_the_same_calibration_gives_the_same_bytes(on_table, demanding, pages):
    assert without_layout(demanding) == pages['demanding']
    assert str(residual_figure(on_table)) in pages['on_table']


def test_identifiers_of_different_figures_do_not_meet(pages):
    found = [
        set(re.findall(r' id="([^"]+)"', svg))
        for svg in re.findall(r'<svg.*?</svg>', pages['on_table'], flags=re.S)
    ]
    assert len(found) > 8
    assert sum(map(len, found)) == len(set().union(*found))


def test_every_parameter_is_there_with_the_digits_that_it_deserves(on_table, pages):
    calibration = on_table.calibration
    for name, value, sd in zip(calibration.param_names, calibration.values, calibration.sd):
        assert f'title="{name}"' in pages['on_table']
        if '.matrix.' in name:
            shown, spread = with_sd(value, sd)
            assert (
                f'>{shown.replace("-", "−")}</td><td class="n quiet">{spread}<' in pages['on_table']
            )


@pytest.mark.parametrize(
    ('name', 'word', 'next_step'),
    (
        ('on_table', 'helps', 'compensate'),
        ('by_hand', 'helps', 'gravity'),
        ('demanding', 'helps', 'accelerometer.accel_size_effect'),
    ),
)
def test_the_decision_comes_first_with_its_next_step(pages, name, word, next_step):
    head = pages[name][: pages[name].index('<nav>')]
    assert f'<section class="verdict {word}">' in head
    assert next_step.lower() in head.lower()


def test_windows_after_calibration_scatter_as_noise_alone_would(on_table, by_hand):
    for result in (on_table, by_hand):
        errors = result.window_errors()
        for sensor in ('accelerometer', 'gyroscope'):
            ratio = np.sqrt(np.mean((errors.after[sensor] / errors.floor[sensor]) ** 2))
            assert 0.3 < ratio < 1.3  # by hand two of three components of each pose are fitted
            assert np.linalg.norm(errors.before[sensor]) > 8 * np.linalg.norm(errors.after[sensor])


def test_errors_after_calibration_are_of_held_out_windows(on_table, by_hand):
    """Errors with the parameters of all windows are smaller."""
    for result in (on_table, by_hand):
        errors, known = result.window_errors(), result.calibration
        for sensor in ('accelerometer', 'gyroscope')[: 2 if result is on_table else 1]:
            inverse = np.linalg.inv(known.of(sensor, Role.LINEAR))
            fitted = (
                (_fitted(result, sensor) @ inverse.T)
                if result is on_table
                else result.applied.compensate(
                    result.applied.poses.force, result.applied.poses.rate, result.applied.poses.time
                )[0]
                - errors.true[sensor]
            )
            assert 1.0 < np.linalg.norm(errors.after[sensor]) / np.linalg.norm(fitted) < 4.0


def _fitted(result, sensor):
    """Return the residuals of window means with the parameters of all windows."""
    means = np.array(
        [
            row.sensors[sensor].mean
            for row in restrict(result.gathered.accumulator, result.data.model, result.model).rows
        ]
    )
    return means[:, -3:] - means[:, :-3] @ coefficients(
        result.model, sensor, result.solution.values
    )


def test_readings_at_one_g_are_zhangs_tables(on_table):
    at_rest, moving = reading_tables(on_table, on_table.window_errors())
    assert [reading.position for reading in at_rest[::3]] == ['+x', '+y', '+z', '-x', '-y', '-z']
    before, after = (
        np.array(
            [abs(getattr(reading, name) - reading.theoretical_g) for reading in at_rest]
        ).reshape(-1, 3)
        * 1e3  # mg
        for name in ('before_g', 'after_g')
    )
    assert after.max() < 0.6  # noise of a mean over 2 s is below 0.1
    assert before.max(axis=1).min() > 1.0
    assert all(reading.rate_deg_s > 0 for reading in moving)


def test_expected_drift_at_rest_is_that_of_simulated_runs(on_table):
    """Noise and constant errors, integrated by the strapdown equations themselves."""
    errors = on_table.window_errors()
    _, parts = expected_growth(on_table, errors)
    rng, period, seconds = np.random.default_rng(3), 0.05, 50.0
    time = np.arange(0.0, seconds + period / 2, period)
    densities = noise_densities(on_table)
    assert densities == pytest.approx(
        [GRADES['industrial'].noise.accel_density, GRADES['industrial'].noise.gyro_density], rel=0.1
    )
    ends = []
    for _ in range(150):
        force, rate = (rng.normal(0, d / np.sqrt(period), (len(time), 3)) for d in densities)
        ends.append(
            [
                np.linalg.norm(part[-1])
                for part in strapdown.strapdown(time, force + [0, 0, 9.81], rate, gravity=9.81)
            ]
        )
    rms = np.sqrt(np.mean(np.square(ends), axis=0))
    # 150 runs: 4 % each.
    assert rms == pytest.approx(
        [parts['noise'].velocity[0, -1], parts['noise'].position[0, -1]], rel=0.2
    )


def test_drift_in_motion_falls_by_the_calibration(on_table):
    before, after = motion_growth(on_table)
    assert np.all(before.velocity[:, 0] == 0) and before.time[-1] >= 5.0
    assert np.all(after.position[:, -1] < 0.2 * before.position[:, -1])


def test_white_residuals_show_no_autocorrelation_and_a_wrong_model_does(on_table):
    for lags, values, bound in autocorrelation(on_table).values():
        assert values[0] == pytest.approx(1.0)
        assert np.mean(np.abs(values[1:]) < bound) > 0.85
    wrong = on_table.solution.values.copy()
    wrong[on_table.solution.model.slices['gyroscope', 'matrix']] += 0.01
    _, values, bound = autocorrelation(
        replace(on_table, solution=replace(on_table.solution, values=wrong))
    )['gyroscope']
    assert np.max(np.abs(values[1:])) > 10 * bound


def test_a_recording_with_an_unmodelled_effect_recommends_a_diagnosis(quick):
    """A lag of 20 ms in the gyroscope leaves far more than noise in motion."""
    late = replace(
        quick.imu,
        rate_s=np.concatenate([np.repeat(quick.imu.rate_s[:1], 2, axis=0), quick.imu.rate_s[:-2]]),
    )
    result = calibrated_on_table([[SampleBlock(late, quick.joints)]], TABLE, SEARCHING)
    assert 'imu_calibration diagnose' in without_layout(result)


def test_numbers_are_printed_for_people():
    assert number_text(0.00012345) == '0.000123'
    assert number_text(-4.5e-7, 2) == '−4.5·10⁻⁷'
    assert number_text(float('nan')) == '–'
    assert fixed(-0.0000001, 3) == '0.000'


def chromium():
    """Return the browser, or skip."""
    for name in ('chromium', 'chromium-browser', 'google-chrome'):
        if shutil.which(name):
            return shutil.which(name)
    pytest.skip('no chromium here; install it to have the report opened in a browser')


WATCH = """<script>window.addEventListener('load', () => {
const shown = [], isText = child => child.nodeType === 3 && child.textContent.trim();
const nodes = document.querySelectorAll('body *:not(script):not(svg *)');
for (const node of nodes) for (const child of [...node.childNodes].filter(isText)) {
  const range = document.createRange(); range.selectNodeContents(child);
  const frame = node.closest('.wide, pre, .pair > div');
  const clips = frame && getComputedStyle(frame).overflowX !== 'visible';
  const limit = clips ? frame.getBoundingClientRect().right : Infinity;
  for (const r of range.getClientRects())
    if (r.left < limit - 1) shown.push([r.left, Math.min(r.right, limit), r.top, r.bottom]); }
let overlaps = 0;
for (const [k, a] of shown.entries()) for (const b of shown.slice(k + 1))
  if (Math.min(a[1], b[1]) - Math.max(a[0], b[0]) > 1
      && Math.min(a[3], b[3]) - Math.max(a[2], b[2]) > 6) overlaps += 1;
const frames = [...document.querySelectorAll('.wide, .scroll, pre, .pair > div')];
const cut = frames.filter(e => e.scrollWidth > e.clientWidth + 1).length;
const wide = document.documentElement.scrollWidth - window.innerWidth;
const figures = [...document.querySelectorAll('svg')];
const flat = figures.filter(s => s.getBoundingClientRect().height < 50).length;
parent.postMessage(
  `wide ${wide} flat ${flat} overlaps ${overlaps} cut ${cut} figures ${figures.length}`, '*');
});</script></body>"""


FRAMES = """<body><script>
const frames = document.getElementsByTagName('iframe');
window.addEventListener('message', event => {
  const place = [...frames].findIndex(frame => frame.contentWindow === event.source);
  document.body.append(`[${place} ${event.data}]`);
});</script>"""
"""Beginning of a page of frames, which prints what each of them measures."""
PAPER = 717
"""Width of A4 between chromium's margins, pixels."""
VIEWS = (
    ('on_table', 1300),
    ('on_table', 800),
    ('on_table', 500),
    ('by_hand', 500),
    ('on_table', PAPER),
    ('by_hand', PAPER),
)
"""(Report, width); those as wide as paper are shown as they are printed."""


@pytest.fixture(scope='module')
def shown(pages, tmp_path_factory):
    """{(report, width): {what was measured: number}} in frames of one browser."""
    folder = tmp_path_factory.mktemp('browser')
    frames = [FRAMES]
    for name, width in VIEWS:
        page = pages[name].replace('</body>', WATCH)
        if width == PAPER:
            page = page.replace('@media print', '@media all')
        (folder / f'{name}_{width}.html').write_text(page)
        frames.append(f'<iframe src="{name}_{width}.html" width="{width}" height="1000"></iframe>')
    (folder / 'frames.html').write_text('\n'.join(frames))
    flags = [
        '--headless',
        '--no-sandbox',
        '--disable-gpu',
        '--disable-quic',
        '--no-first-run',
        '--disable-background-networking',
        '--disable-component-update',
        '--disable-sync',
        '--disable-dev-shm-usage',
        '--enable-logging=stderr',
        f'--user-data-dir={folder / "profile"}',
        '--virtual-time-budget=3000',
        '--dump-dom',
    ]
    done = subprocess.run(
        [chromium(), *flags, (folder / 'frames.html').as_uri()],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert [line for line in done.stderr.splitlines() if 'CONSOLE' in line] == []
    measured = {}
    for place, line in re.findall(r'\[(\d) (wide [^]]*)\]', done.stdout):
        words = line.split()
        measured[VIEWS[int(place)]] = dict(zip(words[::2], map(int, words[1::2]), strict=True))
    assert measured.keys() == set(VIEWS), done.stdout[-300:]
    return measured


@pytest.mark.live
@pytest.mark.parametrize('view', [view for view in VIEWS if view[1] != PAPER])
def test_a_browser_shows_it_without_errors_overflow_or_overlap(shown, view):
    found = shown[view]
    assert found['wide'] <= 0 and found['figures'] >= 6
    assert (found['flat'], found['overlaps']) == (0, 0)


@pytest.mark.live
@pytest.mark.parametrize('name', ('on_table', 'by_hand'))
def test_nothing_is_cut_off_on_paper(shown, name):
    found = shown[name, PAPER]
    assert (found['cut'], found['overlaps'], found['flat']) == (0, 0, 0)
