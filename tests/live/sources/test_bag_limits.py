"""Bags: what their chunks unpack to is counted before they are opened, and their tables must be tables."""

from collections.abc import Callable
from pathlib import Path

import pytest

from ballfg.live.sources.bag import check_bag
from ballfg.simulation import SimulationConfig, simulate
from tests.faults.bombs_of_others import OTHERS, mcap
from tests.importing.test_forms import an_mcap_bag


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
@pytest.mark.parametrize("says", [None, 100])
def test_chunks_are_counted_whatever_they_say(tmp_path: Path, compression: str, says: int | None) -> None:
    mcap(compression, says, 60_000_000)(tmp_path / "a.mcap")
    with pytest.raises(ValueError, match=r"a\.mcap must unpack to at most 3\d MB"):
        check_bag(tmp_path / "a.mcap")
    mcap(compression, says, 20_000_000)(tmp_path / "a.mcap")
    check_bag(tmp_path / "a.mcap")


@pytest.mark.parametrize("bomb", ["db3/a view", "db3/a view beside tables", "db3/a computed column"])
def test_tables_that_compute_are_refused(tmp_path: Path, bomb: str) -> None:
    write: Callable[[Path], object] = OTHERS[bomb][2]
    write(tmp_path / "a.db3")
    with pytest.raises(ValueError, match=r"a\.db3 must hold plain tables"):
        check_bag(tmp_path / "a.db3")


def test_a_good_bag_passes(tmp_path: Path) -> None:
    check_bag(an_mcap_bag(tmp_path, [shot.track for shot in simulate(SimulationConfig(2, seed=3))]))
