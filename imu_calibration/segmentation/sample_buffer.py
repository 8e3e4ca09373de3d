"""Buffered samples."""

from typing import Any

import numpy as np

from imu_calibration.samples import ImuSamples, JointSamples, TemperatureSamples


class SampleBuffer:
    """Samples of one stream in the order of their stamps; joins its blocks only when read."""

    def __init__(self) -> None:
        self.newest_ns: int | None = None
        self._blocks = []

    def __len__(self) -> int:
        return sum(len(block) for block in self._blocks)

    def add(self, samples: ImuSamples | JointSamples | TemperatureSamples) -> None:
        """Append samples; all stamps must exceed the buffered ones."""
        if len(samples):
            self.newest_ns = int(samples.stamp_ns[-1])
            self._blocks.append(samples)

    def between(self, first_ns: int, stop_ns: int) -> Any:
        """Return the samples with stamps in [first, stop), or None when the buffer is empty."""
        samples = self._joined()
        if samples is None:
            return None
        return samples.select(slice(*np.searchsorted(samples.stamp_ns, [first_ns, stop_ns])))

    def first_from(self, stamp_ns: int) -> int | None:
        """Return the first stamp that is not before `stamp_ns`, or None."""
        samples = self._joined()
        if samples is None:
            return None
        place = np.searchsorted(samples.stamp_ns, stamp_ns)
        return int(samples.stamp_ns[place]) if place < len(samples) else None

    def forget_before(self, stamp_ns: int, keep_one: bool = False) -> None:
        """Drop samples before `stamp_ns`; with `keep_one` not the last one of them."""
        while len(self._blocks) > 1 and self._blocks[1].stamp_ns[0] < stamp_ns:
            del self._blocks[0]
        if self._blocks and self._blocks[0].stamp_ns[0] < stamp_ns:
            block = self._blocks[0]
            place = max(0, int(np.searchsorted(block.stamp_ns, stamp_ns)) - keep_one)
            if place:
                kept = block.select(slice(place, None))
                self._blocks[:1] = [_owned(kept)] if len(kept) else []

    def _joined(self):
        if len(self._blocks) > 1:
            self._blocks = [type(self._blocks[0]).concatenate(self._blocks)]
        return self._blocks[0] if self._blocks else None


def _owned(samples):
    """Return a copy of `samples`: a slice would keep the complete block in memory."""
    return type(samples).concatenate([samples])
