"""Replays a dataset as a stream: its tracks one after the other, at their measured rate."""

import threading
from collections.abc import Iterable, Iterator
from time import perf_counter

from ballfg.live.sources.lines import Sample
from ballfg.live.sources.sender import Line, Sender
from ballfg.live.sources.source import Source
from ballfg.tracks import Dataset
from ballfg.tracks.stamps import written

PAUSE = 1.0  # s between two tracks: longer than a ball may stay unseen


class Replay(Source):
    """Samples at their own pace, or a multiple of it.

    Args: samples: with their stamps, which set the pace.  speed: 1 is real time; 0 is without pauses.
    """

    repeats = True

    def __init__(self, samples: Iterable[Sample], speed: float, name: str) -> None:
        self.samples = samples
        self.speed = speed
        self.live = speed > 0.0
        self.name = name

    def lines(self, stop: threading.Event) -> Iterator[Line]:
        """As `Source.lines`."""
        sender = Sender()
        begun: tuple[float, float] | None = None
        for sample in self.samples:
            sender.wait_for_room(stop)
            if self.live:
                begun = begun or (perf_counter(), sample.time)
                wait = begun[0] + (sample.time - begun[1]) / self.speed - perf_counter()
                if wait > 0.0 and stop.wait(wait):
                    return
            yield Line(sender, perf_counter(), sample)


def dataset_samples(dataset: Dataset) -> Iterator[Sample]:
    """The samples of a dataset on one clock: each track begins `PAUSE` after the end of the previous one.

    Their tags hold the trajectory and the stamp on its own clock.
    """
    origin: float | None = None
    begins = 0.0  # s, from the first track's first sample to this one's
    for track in dataset:
        origin = float(track.times[0]) if origin is None else origin
        moments = zip(track.times.tolist(), track.seconds.tolist(), track.positions.tolist(), strict=True)
        for k, (time, since, position) in enumerate(moments):
            sigmas = None if track.sigmas is None else [track.sigmas[k].tolist()]
            stamp = float(written(begins + since, origin))
            yield Sample(stamp, [position], sigmas, (("trajectory", track.name), ("t_track", time)))
        begins += track.duration + PAUSE
