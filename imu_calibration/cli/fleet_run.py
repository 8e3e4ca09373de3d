"""The fleet's work: units out to the workers, results back into files and tables."""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from imu_calibration.api.choices import provenance_with, require_same_inputs, topics_of
from imu_calibration.api.recordings import (
    Topics,
    jobs_for,
    on_cluster,
    provenance_of,
    source_of,
)
from imu_calibration.api.references import reference_of
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.cli.parser import Options, VerbResult
from imu_calibration.cli.show import show_table, warn
from imu_calibration.cli.terminal import Terminal
from imu_calibration.core.errors import ImuCalibrationError, InputError, printable, with_hint
from imu_calibration.core.processes import in_processes
from imu_calibration.core.progress import counter
from imu_calibration.core.units import for_people, significant, with_sd
from imu_calibration.document import files
from imu_calibration.document.decision import HARMS, HELPS, UNPROVEN
from imu_calibration.kinematics.joint import JointNames
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.exclusion import (
    Exclusion,
    WithoutExcluded,
    exclusions_of_units,
    parse_exclusions,
)
from imu_calibration.references.turntable.fleet import (
    FleetStep,
    Spread,
    Unit,
    UnitResult,
    summarise,
)
from imu_calibration.report.calibration_sections import calibration_report
from imu_calibration.report.page import render
from msg_adapters.storages import suffixes


def find_units(folder: str, output: str) -> list[tuple[str, list[Path]]]:
    """
    Return (name, paths of recordings) for each unit.

    A unit is a bag, or a sub-folder that holds bags, which are joined.

    Parameters
    ----------
    folder : path-like
        Folder of units.
    output : path-like
        Folder of results, left out when it lies in `folder`.

    Raises
    ------
    InputError
        When the folder does not exist or holds no unit.

    """
    folder = Path(folder)
    output = Path(output).resolve()
    if not folder.is_dir():
        raise InputError(
            f'the folder of units {folder} must exist, there is none; correct the path'
        )
    unit_paths = []
    for path in sorted(folder.iterdir()):
        if path.name.startswith('.') or path.resolve() == output:
            continue
        if path.is_dir() or is_bag(path):
            unit_paths.append(path)
    names = [path.name if path.is_dir() else path.stem for path in unit_paths]
    units = []
    for path, name in zip(unit_paths, names):
        # A folder without bags is a unit too: its failure is shown, where it would be missed else.
        bags = bags_of(path) or [path]
        # With its suffix, a file has another name than a file or folder that differs only in that.
        units.append((name if names.count(name) == 1 else path.name, bags))
    if not units:
        raise InputError(
            f'{folder} must hold one bag or one sub-folder with bags per unit, there is none; give'
            ' the folder above the bags'
        )
    return units


def bags_of(path: Path) -> list[Path]:
    """Return the recordings of a unit in order of name."""
    return [path] if is_bag(path) else [inner for inner in sorted(path.iterdir()) if is_bag(inner)]


def is_bag(path: Path) -> bool:
    """Return whether a path has the form of a recording."""
    if not path.is_dir():
        return path.suffix in (*suffixes(), '.bag')
    if (path / 'metadata.yaml').exists():
        return True
    return any(inner.suffix in suffixes() for inner in path.iterdir())


def fleet_unit(
    name: str,
    paths: Sequence[Path],
    topics: Topics,
    *,
    joint_names: JointNames,
    options: dict[str, Any],
    exclusions: Sequence[Sequence[Exclusion]] | None = None,
) -> Unit:
    """
    Return the Unit with sources that read the bags without reporting progress.

    `exclusions`: times of each recording that are not used.
    """
    paths = [path.resolve() for path in paths]
    sources = []
    for number, path in enumerate(paths):
        source = source_of(path, topics, joint_names, quiet=True)
        if exclusions and exclusions[number]:
            source = WithoutExcluded(source, exclusions[number])
        sources.append(source)
    return Unit(
        name,
        tuple(sources),
        tuple(path.name for path in paths),
        partial(provenance_of, paths, options),
    )


CSV_KEYS = (
    'parameter',
    'unit',
    'units_determining',
    'mean',
    'spread',
    'typical_sd',
    'spread_over_sd',
    'lowest',
    'lowest_unit',
    'highest',
    'highest_unit',
)


def run_fleet(options: Options, settings: CalibrationOptions) -> VerbResult:
    """Calibrate every unit of a folder."""
    paths_of_units = find_units(options.folder, options.output)
    all_paths = []
    for _, paths in paths_of_units:
        all_paths += paths
    table = _table(options, all_paths)
    units = _units(options, paths_of_units, table)
    if not options.force:
        _require_same_units(Path(options.output), units, report=not options.no_report)

    # Calibrate the units here or on a cluster, then write the files of each.
    with files.output_folder(options.output) as folder:
        advance = counter('units', len(units))
        step = FleetStep(table, settings, None if options.no_report else calibration_report)
        arguments = [(unit,) for unit in units]
        if options.scheduler:
            results = on_cluster(options.scheduler, step.calibrate, arguments, advance=advance)
        else:
            jobs = jobs_for(options.jobs, len(units))
            results = in_processes(step.calibrate, arguments, jobs, advance=advance)
        spreads = summarise(results)
        reasons = []
        for result in results:
            reasons += [f'{result.name}: {line}' for line in result.reasons]
            if result.files:
                files.write_texts(folder / result.name, result.files)

        # The spread over the units, as tables and as a page.
        parameter_rows = fleet_parameter_rows(spreads)
        unit_rows = fleet_unit_rows(results)
        files.write_texts(
            folder,
            {
                'summary.csv': csv_text(parameter_rows),
                'units.csv': csv_text(unit_rows),
                'summary.html': summary_html(results, spreads),
            },
        )
        show_fleet(results, spreads, folder, hints=options.hints())
    return VerbResult(
        3 if any(result.exit_code for result in results) else 0,
        {'units': unit_rows, 'parameters': parameter_rows},
        reasons,
    )


def _units(
    options: Options, paths_of_units: Sequence[tuple[str, list[Path]]], table: Table
) -> list[Unit]:
    """Return the units of `find_units`, each with its recordings and its exclusions."""
    choices = options.choices()
    provenance_options = provenance_with('fleet', (), choices, stand=options.stand())['options']
    recordings_of_unit = {}
    for name, paths in paths_of_units:
        recordings_of_unit[name] = [path.name for path in paths]
    exclusions = exclusions_of_units(
        parse_exclusions(options.exclude) if options.exclude else (), recordings_of_unit
    )
    units = []
    for name, paths in paths_of_units:
        units.append(
            fleet_unit(
                name,
                paths,
                topics_of(choices),
                joint_names=table.joint_names,
                options=provenance_options,
                exclusions=exclusions[name],
            )
        )
    return units


def _require_same_units(folder: Path, units: Sequence[Unit], *, report: bool) -> None:
    """Refuse a folder with a result of other recordings for one of the units."""
    for unit in units:
        provenance: Mapping[str, Any] = {}
        if (folder / unit.name / 'calibration.yaml').exists():
            try:
                provenance = unit.provenance()
            except (ImuCalibrationError, OSError):
                continue  # A unit that cannot be read gives no file.
        require_same_inputs(folder / unit.name, partial(dict, provenance), report=report)


def _table(options: Options, bags: Sequence[Path]) -> Table:
    """
    Return the chain of joints; a description in recordings is read from the first readable one.
    """
    stand = options.stand()
    topics = topics_of(options.choices())
    purpose = 'a fleet is calibrated on a table or an arm'
    for bag in bags[:-1]:
        try:
            return reference_of(stand, [bag], topics).table_for(purpose)
        except InputError:
            pass
    return reference_of(stand, bags[-1:], topics).table_for(purpose)


def fleet_parameter_rows(spreads: Sequence[Spread]) -> list[dict[str, Any]]:
    """Return the summary: one row per parameter, SI."""
    rows = []
    for spread in spreads:
        cells = (
            spread.name,
            spread.unit,
            spread.count,
            spread.mean,
            spread.spread,
            spread.typical_sd,
            spread.ratio,
            *spread.lowest,
            *spread.highest,
        )
        rows.append(dict(zip(CSV_KEYS, cells, strict=True)))
    return rows


def fleet_unit_rows(results: Sequence[UnitResult]) -> list[dict[str, Any]]:
    """
    Return one row per unit.

    It has the decisions, the exit code, the reason of a refusal, the number of dropped samples, and
    each parameter with its sd, SI; None: unknown.
    """
    # Every row has the parameters of all units, in the order of the first unit with each.
    parameters: dict[str, float | None] = {}
    for result in results:
        if result.calibration is not None:
            for name in result.calibration.param_names:
                parameters |= {name: None, f'{name}.sd': None}
    rows = []
    for result in results:
        numbers = dict(parameters)
        dropped = None
        if result.calibration is not None:
            calibration = result.calibration
            for name, value, sd in zip(calibration.param_names, calibration.values, calibration.sd):
                numbers |= {name: value, f'{name}.sd': sd}
            dropped = sum((calibration.statistics.get('dropped') or {}).values())
        row = {
            'name': result.name,
            'decision': result.verdict,
            **result.verdicts,
            'exit_code': result.exit_code,
            'error': result.error,
            'dropped': dropped,
        }
        rows.append(row | numbers)
    return rows


def csv_text(rows: Sequence[dict[str, Any]]) -> str:
    """
    Return rows as CSV with a heading.

    Unknown values are empty, and text that a spreadsheet would calculate begins with a quote.
    """
    text = io.StringIO()
    writer = csv.DictWriter(text, rows[0] if rows else CSV_KEYS, lineterminator='\n')
    writer.writeheader()
    for row in rows:
        writer.writerow({key: _cell(value) for key, value in row.items()})
    return text.getvalue()


def _cell(value: Any) -> Any:
    """Return a value as a cell of a CSV file, see `csv_text`."""
    if isinstance(value, str):
        # Spreadsheets skip blanks in front of a formula, and a bare \r begins another row.
        value = printable(value)
        return f"'{value}" if value.strip()[:1] in tuple('=+-@') else value
    if isinstance(value, float) and math.isnan(value):
        return ''
    return value


def printed_parameter(spread: Spread) -> tuple[str, ...]:
    """
    Return the printed cells of a parameter, in the order of `SPREAD_HEADINGS`.
    """
    factor, unit = for_people(spread.unit, spread.name)
    if not spread.count:
        return spread.name, 'held', '', '', unit, '', ''
    mean, sd = with_sd(spread.mean * factor, spread.typical_sd * factor)
    if spread.count == 1:
        return spread.name, mean, '', sd, unit, '', spread.lowest[1]
    return (
        spread.name,
        mean,
        significant(spread.spread * factor),
        sd,
        unit,
        significant(spread.ratio),
        f'{spread.lowest[1]} .. {spread.highest[1]}',
    )


SPREAD_HEADINGS = (
    'parameter',
    'mean',
    'spread',
    'typical sd',
    'unit',
    'spread / sd',
    'lowest .. highest unit',
)


def show_fleet(
    results: Sequence[UnitResult], spreads: Sequence[Spread], folder: Path, *, hints: dict[str, str]
) -> None:
    """Print the spread of each parameter, the units, and where the files are."""
    out = Terminal.of()
    show_table(
        out,
        SPREAD_HEADINGS,
        map(printed_parameter, spreads),
        numbers=('mean', 'spread', 'typical sd', 'spread / sd'),
    )
    for result in results:
        out.print(
            f'{result.name}: {with_hint(result.error, result.key, hints) or result.verdict_text}'
        )
        if result.calibration is not None:
            for finding in result.calibration.statistics['preflight']:
                warn([{**finding, 'text': f'{result.name}: {finding["text"]}'}])
    n_calibrated = sum(result.calibration is not None for result in results)
    out.print(
        f'written: {n_calibrated} of {len(results)} units, summary.csv, units.csv and summary.html'
        f' in {folder}'
    )


def summary_html(results: Sequence[UnitResult], spreads: Sequence[Spread]) -> str:
    """Return the summary as one page."""
    verdicts = [result.verdict for result in results]
    word = HARMS
    if set(verdicts) == {HELPS}:
        word = HELPS
    elif set(verdicts) <= {HELPS, UNPROVEN}:
        word = UNPROVEN
    headline = (
        f'The calibration helps both sensors of {verdicts.count(HELPS)} of {len(results)} units'
    )
    return render(
        'fleet.html',
        title='Calibration of a fleet',
        headline=headline,
        word=word,
        results=results,
        columns=SPREAD_HEADINGS,
        rows=[printed_parameter(spread) for spread in spreads],
    )
