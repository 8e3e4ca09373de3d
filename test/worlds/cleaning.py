"""A whole stream cleaned at once."""

from imu_calibration.preprocessing.stream_cleaning import StreamCheck


def clean_samples(samples, gap=0.1):
    """
    Clean a whole recording of one stream.

    Returns
    -------
    list of samples
        One item per epoch of the clock, in order, without empty ones.
    StreamStatistics
        What was dropped and how the stamps look.

    """
    check = StreamCheck()
    pieces = check.push(samples) + check.finish()
    epochs = [
        type(samples).concatenate([part for number, part in pieces if number == epoch])
        for epoch in sorted({n for n, _ in pieces})
    ]
    return [part for part in epochs if len(part)], check.statistics(gap)
