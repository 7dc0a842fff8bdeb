"""Makes tracks from the sightings in a dataset's folder: `detections.csv`, `cameras.yaml`, `events.csv`."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from os import PathLike
from pathlib import Path
from types import MappingProxyType
from typing import Final

import numpy as np

from ballfg.arrays import Array
from ballfg.checks import listed, shown
from ballfg.dynamics.nominal import nominal_model
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.observations.rig import cameras_of, check_clocks, check_one_flight, in_order, with_ends
from ballfg.estimation.observations.shadows import SHADOWS_FILE, with_shadows
from ballfg.estimation.observations.sightings import TooFewSightingsError, sighted_track
from ballfg.files.whole_folder import of_one_state
from ballfg.tracks import csv_files
from ballfg.tracks.detections_file import DETECTIONS_FILE, EVENTS_FILE, check_inside, read_sightings
from ballfg.tracks.info import INFO_FILE, DatasetInfo, TrackFolder, read_info
from ballfg.tracks.labels import LABELS_FILE, LabelTable, read_labels
from ballfg.tracks.rows import KEY
from ballfg.tracks.sightings import Sightings
from ballfg.tracks.track import Track
from ballfg.vision.camera import Camera
from ballfg.vision.camera_file import CAMERAS_FILE, read_cameras


class SightedDataset(TrackFolder):
    """The tracks of a folder from its sightings; made by `read_sighted`. The folder needs no table of tracks.

    Attributes:
        path: the folder.  info: what `dataset.yaml` states.  cameras: of the rig.
        notes: ignored rows and balls, one sentence each.  label_names: of the labels, in the order of `labels.csv`.

    Raises: ValueError: cameras with numbers that no lens has.
    """

    rough: Final = True  # The positions of the tracks are made from the sightings

    has_sigmas: Final = False  # The errors of these positions are not stated

    def __init__(
        self,
        path: Path,
        info: DatasetInfo,
        cameras: tuple[Camera, ...],
        balls: dict[str, Sightings],
        labels: LabelTable,
        notes: list[str],
        bounces: Mapping[str, Array] = MappingProxyType({}),
        shadows: Mapping[str, Sightings] = MappingProxyType({}),
    ) -> None:
        self.path, self.info, self.cameras, self.notes = path, info, cameras, notes
        self.label_names = labels.names
        self._tracks = {}
        model = nominal_model(info.ball)
        surfaces = replace(Surfaces.table_tennis(self.table), extent=info.table_extent)
        for name, sightings in balls.items():
            known, own, rig = bounces.get(name), labels.of(name), list(cameras)
            if name in shadows and info.lamp is not None:
                try:
                    sightings, rig = with_shadows(sightings, shadows[name], cameras, info.lamp, self.table)
                except ValueError as error:
                    raise ValueError(f"{path / SHADOWS_FILE}, trajectory {shown(name)}: {error}") from None
            try:
                seen = in_order(with_ends(sightings, cameras_of(sightings, rig)), rig)
                check_clocks(name, seen, cameras_of(seen, rig))
                track = sighted_track(name, seen, rig, own, model=model, surfaces=surfaces, bounces=known)
                check_one_flight(track)
                self._tracks[name] = replace(track, dataset=self)
            except TooFewSightingsError as error:
                notes.append(str(error))
            except ValueError as error:  # cameras at one point, with other clocks, with numbers that no lens has
                raise ValueError(f"{path}: {error} Look at {CAMERAS_FILE}.") from None
        self.one_view = all(track.one_view for track in self)

    def __len__(self) -> int:
        return len(self._tracks)

    def __iter__(self) -> Iterator[Track]:
        return iter(self._tracks.values())

    def __repr__(self) -> str:
        return f"SightedDataset({self.info.name!r}, {len(self)} tracks, {len(self.cameras)} cameras)"

    def __getitem__(self, name: str) -> Track:
        """One track by its name.

        Raises: ValueError: if there is no track of that name.
        """
        if name not in self._tracks:
            raise ValueError(
                f"name must be one of the {len(self)} trajectories of {self.path}; got {shown(name)}. See names."
            )
        return self._tracks[name]

    @property
    def names(self) -> list[str]:
        """The names of the trajectories, in the order of the tracks."""
        return list(self._tracks)


@of_one_state
def read_sighted(folder: str | PathLike[str]) -> SightedDataset:
    """Opens the detections of a dataset and checks all of them. They are held in memory.

    Args:
        folder: holds `dataset.yaml`, `cameras.yaml`, `detections.csv` with the trajectory of each row, and optionally
            `labels.csv`, `events.csv`, whose bounces of a ball that one camera saw are not searched for again, and
            `shadows.csv`, with the columns of `detections.csv`: shadows on the table by the lamp in `dataset.yaml`.
    Returns: the balls that were seen often enough; `notes` list the others.
    Raises:
        FileNotFoundError: one of the files is missing.
        ValueError: the content breaks a rule, or there is no ball in it; the message names file, line and remedy.
    """
    path = Path(folder)
    for name in (INFO_FILE, CAMERAS_FILE, DETECTIONS_FILE):
        if not (path / name).is_file():
            raise FileNotFoundError(
                f"{path} must hold {INFO_FILE}, {CAMERAS_FILE} and {DETECTIONS_FILE} for an estimate from detections; "
                f"{name} is missing. Add it, or make the folder with 'ballfg track'."
            )
    info, notes = read_info(path / INFO_FILE)
    cameras = tuple(read_cameras(path / CAMERAS_FILE))
    offsets = {camera.name: camera.time_offset for camera in cameras}
    balls, more = read_sightings(path / DETECTIONS_FILE, offsets)
    shadows = dict[str, Sightings]()
    if (path / SHADOWS_FILE).is_file():
        shadows, others = _read_shadows(path, info, offsets, balls)
        more += others
    for number, camera in enumerate(cameras):
        seen = [ball.pixels[ball.camera == number] for ball in balls.values()]
        check_inside(path / DETECTIONS_FILE, camera.name, camera.size, np.concatenate([np.empty((0, 2)), *seen]))
    labels_file = path / LABELS_FILE
    labels = read_labels(labels_file, list(balls)) if labels_file.is_file() else LabelTable({}, {})
    bounces = read_bounces(path / EVENTS_FILE) if (path / EVENTS_FILE).is_file() else {}
    dataset = SightedDataset(path, info, cameras, balls, labels, [*notes, *more, *labels.notes], bounces, shadows)
    if not len(dataset):
        raise ValueError(
            f"{path / DETECTIONS_FILE}: must hold a ball, seen often enough, its name in the column 'trajectory'; got "
            f"none ({len(balls)} named). Find balls with 'ballfg track', or look at the calibration."
        )
    return dataset


def _read_shadows(
    path: Path, info: DatasetInfo, offsets: Mapping[str, float], balls: Mapping[str, Sightings]
) -> tuple[dict[str, Sightings], list[str]]:
    """The shadows of balls in a folder, and notes on what is left out. Raises: ValueError: no lamp, no table."""
    if info.lamp is None:
        raise ValueError(
            f"{path / INFO_FILE}: lamp is required beside {SHADOWS_FILE}; there is none. Write where the lamp "
            "stands, in m, as lamp: {place: [0.5, 0.8, 3.1], sigma: 0.02}."
        )
    if info.table_height is None:
        raise ValueError(
            f"{path / INFO_FILE}: frame.table_height must be a number beside {SHADOWS_FILE}, whose shadows lie on the "
            f"table; got none. Give it, or move {SHADOWS_FILE} away."
        )
    shadows, notes = read_sightings(path / SHADOWS_FILE, offsets)
    if strange := [name for name in shadows if name not in balls]:
        notes.append(f"{SHADOWS_FILE}: shadows of {listed(strange)} left out: no such ball in {DETECTIONS_FILE}")
    return shadows, notes


NEEDED: Final = (KEY, "t", "kind")


def read_bounces(path: Path) -> dict[str, Array]:
    """The stamps (b,) s of the bounces of each trajectory that the file names, ascending.

    Args: path: a table with the columns `trajectory`, `t` (s) and `kind`.
    Raises: ValueError: a column that is missing, a stamp that is no number; the message names the file and the line.
    """
    names = [name.strip() for name in csv_files.read_header(path)]
    if missing := [name for name in NEEDED if name not in names]:
        raise ValueError(f"{path} must have the columns {', '.join(NEEDED)}; {missing[0]} is missing. Track again.")
    found = dict[str, list[float]]()
    for line, cells in csv_files.records(path):
        row = dict(zip(names, (cell.strip() for cell in cells), strict=False))
        if not csv_files.is_number(row.get("t", "")):
            raise ValueError(f"{path}, line {line}: t must be a number; got {row.get('t')!r}. Track again.")
        mine = found.setdefault(row[KEY], [])
        if row.get("kind") == "bounce":
            mine.append(float(row["t"]))
    return {name: np.sort(np.array(times, dtype=np.float64)) for name, times in found.items()}
