"""From a recording at rest to the figures of its noise."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from os import PathLike

from imu_calibration.allan.document import (
    lines,
    noise_exit_code,
    noise_shortcomings,
    noise_to_text,
)
from imu_calibration.allan.figures import HORIZON, NoiseFigures
from imu_calibration.allan.identify import NoiseIdentification, figures_of, identify_noise
from imu_calibration.api.choices import readings_of, require_same_inputs, topics_of
from imu_calibration.api.recordings import provenance_of, source_of, sources_without
from imu_calibration.core.progress import report
from imu_calibration.core.readings import RawReadings
from imu_calibration.core.samples import SampleBlock
from imu_calibration.document import files
from imu_calibration.preprocessing.checks import visible_findings
from imu_calibration.preprocessing.recording_evidence import CheckFinding
from imu_calibration.report.figures import Drawn


@dataclass(frozen=True, eq=False)
class IdentifiedNoise:
    """
    Noise figures from a recording.

    It prints them, draws the Allan curves, and saves noise.yaml and report.html.
    """

    result: NoiseIdentification
    """The identification with all data of a report."""
    figures: NoiseFigures
    """Content of noise.yaml."""
    horizon: float = HORIZON
    """Averaging time at which a random walk approximates the slow noise, s."""

    @property
    def exit_code(self) -> int:
        """0 when every required figure is determined and few messages were lost, otherwise 3."""
        return noise_exit_code(self.figures)

    @property
    def reasons(self) -> list[str]:
        """Why the exit code is 3, a line each."""
        return noise_shortcomings(self.figures)

    @property
    def findings(self) -> tuple[CheckFinding, ...]:
        """Faults of the recording, and how it was read."""
        return tuple(visible_findings(self.result.record.survey.findings))

    def plot(self, sensor: str = 'accelerometer') -> Drawn:
        """Return the Allan deviations of one sensor with their model as a figure for a notebook."""
        from imu_calibration.report.noise_page import draw_curve

        return draw_curve(self.result, sensor)

    @cached_property
    def report(self) -> str:
        """The report as one HTML page."""
        from imu_calibration.report.noise_page import noise_report

        report('drawing the report')
        return noise_report(self.result, self.figures, self.horizon)

    def save(self, folder: str | PathLike, *, report: bool = True, force: bool = False) -> None:
        """
        Write noise.yaml and, when wanted, report.html into a folder.

        The noise of other inputs there is replaced only with `force`.
        """
        if not force:
            require_same_inputs(
                folder, lambda: self.figures.provenance, 'noise.yaml', report=report
            )
        texts = {}
        if report:
            texts[files.REPORT] = self.report
        texts['noise.yaml'] = noise_to_text(self.figures, self.horizon)
        files.write_texts(folder, texts)

    def __str__(self):
        return '\n'.join(lines(self.figures))


def noise_provenance(recording: str | PathLike | SampleBlock) -> dict:
    """Return the provenance of the noise of a recording, without options."""
    return provenance_of([recording], {})


def identify_recording(
    recording: str | PathLike | SampleBlock,
    *,
    imu_topic: str | None = None,
    gyroscope_topic: str | None = None,
    temperature_topic: str | None = None,
    frame_id: str | None = None,
    nominal: str | PathLike | RawReadings | None = None,
    accelerometer_unit: str | None = None,
    gyroscope_unit: str | None = None,
    increments: float | None = None,
    horizon: float = HORIZON,
    exclude: str | None = None,
    columns: Sequence[str] = (),
    where: Sequence[str] = (),
) -> IdentifiedNoise:
    """
    Identify the noise of an IMU from a recording that holds rest.

    Parameters
    ----------
    recording : path-like or SampleBlock
        Bag, or samples in memory; it is read twice.
    imu_topic, gyroscope_topic, temperature_topic : str, optional
        Default /imu/data_raw and /imu/temperature, otherwise the only topics of their types;
        `gyroscope_topic` where the rates have one of their own.
    frame_id : str, optional
        frame_id of the Imu messages; required if the topic has messages of several.
    nominal, accelerometer_unit, gyroscope_unit, increments : optional
        Units of the readings, see `Choices`.
    horizon : float
        Averaging time at which a random walk approximates the slow noise, s.
    exclude : str, optional
        Times that are not used, 'A:B,...' in s since the first stamp of the IMU.
    columns, where : sequence of str
        Columns and rows of a text log, see `Choices`.

    Raises
    ------
    ImuCalibrationError
        When the recording cannot be used, or it has no rest of sufficient length.

    """
    choices = dict(locals())  # the arguments by name, among them some of `Choices`
    readings = readings_of(choices)
    topics = topics_of(choices)
    (source,) = sources_without([source_of(recording, topics)], [recording], exclude)
    result = identify_noise(source, readings)

    # Options for the document, with those of the log one by one.
    chosen = topics.chosen() | {'gyroscope_topic': gyroscope_topic, 'exclude': exclude}
    chosen |= asdict(chosen.pop('log'))
    options = {name: value for name, value in chosen.items() if value}
    if readings is not None:
        options['readings'] = readings.to_mapping()
    return IdentifiedNoise(result, figures_of(result, provenance_of([recording], options)), horizon)
