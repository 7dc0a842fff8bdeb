"""A file format of one's own: a class and its registration are all that an import needs."""

from pathlib import Path

import numpy as np
import pytest

from ballfg.importing import Format, import_tracks, register_format
from ballfg.importing.formats.sources import FORMATS
from tests.importing.throws import thrown


class Packed(Format):
    """Numbers of 64 bits, four a row: t, x, y, z."""

    name = "packed"
    endings = (".trk",)

    @staticmethod
    def read(path: Path) -> dict[str, np.ndarray]:
        rows = np.fromfile(path).reshape(-1, 4)
        return dict(zip(("t [s]", "x [m]", "y [m]", "z [m]"), rows.T, strict=True))


def test_files_of_an_own_format_are_imported(tmp_path: Path) -> None:
    times, positions = thrown()
    np.column_stack((times, positions)).tofile(tmp_path / "one.trk")
    with pytest.raises(ValueError, match=r"must hold|one\.trk"):
        import_tracks(tmp_path)
    with FORMATS.restored():
        register_format(Packed)
        for source in (tmp_path, tmp_path / "one.trk"):
            (track,) = import_tracks(source)
            np.testing.assert_allclose(track.positions, positions, atol=1e-12)
            np.testing.assert_allclose(track.times - track.times[0], times - times[0], atol=1e-12)
