"""A dataset is a folder of tracks that is checked once and then streamed as often as needed."""

import copy
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Final

import numpy as np

from ballfg.checks import check_each, check_instance, check_iterable, check_path, listed, shown
from ballfg.files.whole_folder import of_one_state
from ballfg.tracks.checks import MAX_SIGMA, MIN_SIGMA, Findings, check_scale, tidy
from ballfg.tracks.detections_file import DETECTIONS_FILE
from ballfg.tracks.info import INFO_FILE, DatasetInfo, TrackFolder, read_info
from ballfg.tracks.labels import LABELS_FILE, LabelTable, read_labels
from ballfg.tracks.rows import KEY, SIGMAS, VALUES, Block, CsvRows, Index, ParquetRows, RowSource, groups, scan
from ballfg.tracks.track import Label, Track

TRACK_FILES = ("tracks.csv", "tracks.parquet")


class Dataset(TrackFolder):
    """The tracks of a folder; made by `read_dataset`.

    Iterating streams the file, so that one track at a time is in memory; each `for` loop starts again at the first.
    The tracks come in the order in which their names first appear.

    Attributes:
        path: the folder.
        info: the content of `dataset.yaml`.
        notes: ignored and repaired entries, one sentence each.
    """

    rough: Final = False
    """The positions of the tracks were measured."""

    def __init__(
        self, path: Path, info: DatasetInfo, source: RowSource, index: Index, labels: LabelTable, notes: list[str]
    ) -> None:
        self.path, self.info, self.notes = path, info, notes
        self._source, self._index, self._labels = source, index, labels
        self._attached: Callable[[Track], Track] | None = None

    def __len__(self) -> int:
        return len(self._index.names)

    def __iter__(self) -> Iterator[Track]:
        for group in groups(self._source, self._index):
            values = tidy(group, self._source.where)
            sigmas = values[:, 4:] if self.has_sigmas else None
            track = Track(values[:, 0], values[:, 1:4], sigmas, self._labels.of(group.name), name=group.name)
            yield replace(track if self._attached is None else self._attached(track), dataset=self)

    def __repr__(self) -> str:
        return f"Dataset({self.info.name!r}, {len(self)} tracks, {str(self.path)!r})"

    @property
    def names(self) -> list[str]:
        """The names of the trajectories, in the order of the tracks."""
        return list(self._index.names)

    @property
    def label_names(self) -> list[str]:
        """The names of the labels, in the order of `labels.csv`; empty without such a file."""
        return self._labels.names

    def labels_of(self, name: str) -> dict[str, Label]:
        """The labels of one track, without its positions; none for a track without a row in `labels.csv`."""
        return self._labels.of(name)

    @property
    def has_sigmas(self) -> bool:
        """True if every sample has its own standard deviations."""
        return len(self._source.columns) > 4

    def __getitem__(self, name: str) -> Track:
        """One track by its name, as `track` gives it."""
        return self.track(name)

    def with_readings(self, attached: Callable[[Track], Track], notes: Sequence[str] = ()) -> "Dataset":
        """The dataset with further observations in its tracks.

        Args: attached: adds them to a track.  notes: on ignored entries of their files, one sentence each.
        """
        other = copy.copy(self)
        other._attached, other.notes = attached, [*self.notes, *notes]
        return other

    def track(self, name: str) -> Track:
        """One track by its name; reads the file up to it.

        Raises: ValueError: if there is no track of that name.
        """
        if isinstance(name, str) and name in self._index.names:
            for track in self:
                if track.name == name:
                    return track
        raise ValueError(
            f"name must be one of the {len(self)} trajectories of {self.path}; got {shown(name)}. See names."
        )


def has_positions(folder: str | PathLike[str]) -> bool:
    """True if a folder holds a table of tracks, or has no detections."""
    path = Path(folder)
    return any((path / name).is_file() for name in TRACK_FILES) or not (path / DETECTIONS_FILE).is_file()


@of_one_state
def read_dataset(folder: str | PathLike[str]) -> Dataset:
    """Opens a dataset and checks all of it, so that no error comes in the middle of a stream.

    The table is read twice in blocks (cells first, then whole trajectories); memory does not grow with the number
    of tracks, apart from their names and labels.

    Args: folder: holds `dataset.yaml`, `tracks.csv` or `tracks.parquet`, and optionally `labels.csv`; docs/tracks.md.
    Returns: the dataset; its `notes` list ignored and repaired entries.
    Raises: FileNotFoundError: the folder or one of its files is missing. ValueError: the content breaks a rule; the
        message names file, line, column and remedy.
    """
    path = check_path("folder", folder)
    source = _open_source(path)
    info, notes = read_info(path / INFO_FILE)
    notes += [f"{source.path.name}: column {shown(name)} ignored" for name in source.ignored]
    index = scan(source)
    labels = LabelTable({}, {})
    if (path / LABELS_FILE).is_file():
        labels = read_labels(path / LABELS_FILE, index.names)
        notes += labels.notes
        if missing := len(index.names) - len(labels):
            notes.append(f"{LABELS_FILE}: {missing} of {len(index.names)} trajectories unlabelled")
    findings = Findings()
    for group in groups(source, index):
        values = tidy(group, source.where, findings)
        sigmas = values[:, 4:] if values.shape[1] > 4 else None
        try:
            check_scale(f"trajectory {shown(group.name)}", values[:, 0], values[:, 1:4], sigmas, info.rate)
        except ValueError as error:
            raise ValueError(f"{source.where(int(group.rows[0]))}: {error}") from None
    if not index.contiguous:
        notes.append(f"{source.path.name}: the rows of different trajectories interleave: regrouped at each pass")
    return Dataset(path, info, source, index, labels, notes + findings.notes())


def _open_source(folder: Path) -> RowSource:
    if not folder.exists():
        raise FileNotFoundError(f"folder must exist; {folder} does not. Give the folder of a dataset.")
    if not folder.is_dir():
        raise ValueError(f"folder must be a folder; {folder} is a file. Give the folder that holds {INFO_FILE}.")
    if not (folder / INFO_FILE).is_file():
        raise FileNotFoundError(
            f"{folder} must hold {INFO_FILE}; got {_listing(folder)}. Add it: name, frame and ball (docs/tracks.md)."
        )
    present = [name for name in TRACK_FILES if (folder / name).is_file()]
    if len(present) > 1:
        raise ValueError(f"{folder} must hold one table of tracks; got {' and '.join(present)}. Delete one of them.")
    if not present:
        if (folder / DETECTIONS_FILE).is_file():
            raise FileNotFoundError(
                f"{folder} must hold {' or '.join(TRACK_FILES)}, positions, for this command; it holds sightings of "
                "cameras alone. They serve 'ballfg estimate --from detections', 'ballfg noise', and ballfg-train with "
                "kind: calibrate."
            )
        problem = f"{folder} must hold {' or '.join(TRACK_FILES)}; got {_listing(folder)}"
        raise FileNotFoundError(f"{problem}. Add it: trajectory,t,x,y,z (docs/tracks.md).")
    source = CsvRows if present[0].endswith(".csv") else ParquetRows
    return source(folder / present[0])


def _listing(folder: Path) -> str:
    return listed(sorted(entry.name for entry in folder.iterdir())) if any(folder.iterdir()) else "an empty folder"


def checked(tracks: Iterable[Track], info: DatasetInfo) -> Iterator[Track]:
    """The tracks, each checked on its turn as one of a dataset that can be read.

    Raises: ValueError: no tracks, a repeated name, sigmas of some, or numbers that cannot be metres and seconds.
    """
    names: set[str] = set()
    has_sigmas: bool | None = None
    for track in check_each("tracks", tracks, Track, "Make one with Track(times, positions)."):
        has_sigmas = track.sigmas is not None if has_sigmas is None else has_sigmas
        if track.name in names:
            raise ValueError(f"track names must be unique; got {shown(track.name)} twice. Rename one of them.")
        if len(track) < 2:
            raise ValueError(f"track {shown(track.name)} must have at least two samples; got one. Leave it out.")
        if (track.sigmas is not None) != has_sigmas:
            what = f"tracks must have sigmas all or none; {shown(track.name)} differs from the first"
            raise ValueError(f"{what}. Set sigmas=None in all of them, or give them all.")
        if track.sigmas is not None and not (MIN_SIGMA <= track.sigmas.min() <= track.sigmas.max() <= MAX_SIGMA):
            raise ValueError(
                f"track {shown(track.name)}: sigmas must be {MIN_SIGMA:g} to {MAX_SIGMA:g} m; "
                f"got {track.sigmas.min():g} to {track.sigmas.max():g}. Correct them or set sigmas=None."
            )
        check_scale(f"track {shown(track.name)}", track.times, track.positions, track.sigmas, info.rate)
        names.add(track.name)
        yield track
    if not names:
        raise ValueError("tracks must hold at least one track; got none. Pass the tracks.")


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
    tracks = tuple(checked(tracks, info))
    check_iterable("notes", notes)
    source, counts = MemoryRows(tracks), np.array([len(track) for track in tracks])
    index = Index([track.name for track in tracks], counts, True, source.stamp())
    labels = dict.fromkeys(label for track in tracks for label in track.labels)
    columns: dict[str, list[Label | None]] = {label: [track.labels.get(label) for track in tracks] for label in labels}
    table = LabelTable(columns, {track.name: i for i, track in enumerate(tracks)} if labels else {})
    return Dataset(Path(f"{info.name} (in memory)"), info, source, index, table, list(notes))
