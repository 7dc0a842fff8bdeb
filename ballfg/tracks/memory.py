"""Makes a dataset of tracks in memory."""

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from ballfg.checks import check_each, check_instance, check_iterable, shown
from ballfg.tracks.checks import Findings
from ballfg.tracks.dataset import Dataset, check_group
from ballfg.tracks.grouping import groups, scan
from ballfg.tracks.info import DatasetInfo
from ballfg.tracks.labels import LabelTable
from ballfg.tracks.rows import KEY, SIGMAS, VALUES, Block, RowSource
from ballfg.tracks.track import Label, Track


class MemoryRows(RowSource):
    """The rows of tracks, one block a track."""

    def __init__(self, tracks: Sequence[Track]) -> None:
        sigmas = SIGMAS if tracks[0].sigmas is not None else ()
        super().__init__(Path("memory"), (KEY, *VALUES, *sigmas))
        self._tracks = tracks
        self._starts = np.concatenate([[0], np.cumsum([len(track) for track in tracks])])

    def blocks(self) -> Iterator[Block]:
        """The tracks from the first; see RowSource."""
        for start, track in zip(self._starts[:-1], self._tracks, strict=True):
            parts = [track.times[:, None], track.positions, *([] if track.sigmas is None else [track.sigmas])]
            codes = np.zeros(len(track), dtype=np.int32)
            yield Block(int(start), [track.name], codes, np.concatenate(parts, axis=1))

    def stamp(self) -> tuple[int, int]:
        """Number of rows, and no time: tracks in memory do not change."""
        return int(self._starts[-1]), 0

    def where(self, *rows: int) -> str:
        """The tracks of these rows."""
        places = np.searchsorted(self._starts, rows, side="right") - 1
        return " and ".join(dict.fromkeys(f"track {shown(self._tracks[int(place)].name)}" for place in places))


def dataset_in_memory(info: DatasetInfo, tracks: Sequence[Track], notes: Sequence[str] = ()) -> Dataset:
    """A dataset of tracks without files; it is used like one that was read.

    Args:
        info: the content of `dataset.yaml`.
        tracks: at least one, of two samples or more, with unique names; sigmas for all or for none.
        notes: on their origin, one sentence each.
    Raises: ValueError: no tracks, a repeated name, or a track whose numbers cannot be metres and seconds.
    """
    check_instance("info", info, DatasetInfo, "Make one with DatasetInfo(name, table_height, ball).")
    tracks = tuple(check_each("tracks", tracks, Track, "Make one with Track(times, positions)."))
    check_iterable("notes", notes)
    if not tracks:
        raise ValueError("tracks must hold at least one track; got none. Pass the tracks.")
    if len({track.sigmas is None for track in tracks}) > 1:
        raise ValueError("tracks must have sigmas all or none; some have them. Set sigmas=None in all, or give them.")
    name, count = Counter(track.name for track in tracks).most_common(1)[0]
    if count > 1:
        raise ValueError(f"track names must be unique; got {shown(name)} twice. Rename one of them.")
    source = MemoryRows(tracks)
    index = scan(source)
    findings = Findings()
    for group in groups(source, index):
        check_group(source, group, info, findings)
    labels = dict.fromkeys(label for track in tracks for label in track.labels)
    columns: dict[str, list[Label | None]] = {label: [track.labels.get(label) for track in tracks] for label in labels}
    table = LabelTable(columns, {track.name: i for i, track in enumerate(tracks)} if labels else {})
    return Dataset(Path(f"{info.name} (in memory)"), info, source, index, table, [*notes, *findings.notes()])
