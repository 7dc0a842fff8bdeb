"""Any damage to a file is either harmless or refused at once, in one line."""

import random

import numpy as np
import pyarrow.parquet as pq
import pytest

from ballfg.tracks import read_dataset, write_dataset

TOKENS = [
    b",",
    b'"',
    b"\n",
    b"\r",
    b"\0",
    b"\xff",
    b"nan",
    b"1e999",
    b"-",
    b"\t",
    b": ",
    b"[",
    b"#",
    b"\xef\xbb\xbf",
    b"_",
]


def _damaged(content: bytes, rng: random.Random) -> bytes:
    spoilt = bytearray(content)
    for _ in range(rng.randint(1, 3)):
        at = rng.randrange(min(len(spoilt), rng.choice([60, len(spoilt)])) or 1)
        action = rng.randrange(4)
        if action == 0:
            del spoilt[at : at + rng.randint(1, 10)]
        elif action == 1:
            spoilt[at:at] = rng.choice(TOKENS)
        elif action == 2:
            spoilt[at : at + 1] = bytes([rng.randrange(256)])
        else:
            del spoilt[at:]
        spoilt = spoilt or bytearray(b"x")
    return bytes(spoilt)


@pytest.mark.parametrize("name", ["dataset.yaml", "tracks.csv", "labels.csv"])
def test_damage_is_harmless_or_refused(tmp_path, info, make_tracks, name):
    write_dataset(tmp_path, info, make_tracks(4, sigmas=True))
    whole = (tmp_path / name).read_bytes()
    rng = random.Random(5)
    messages = []
    for _ in range(300):
        (tmp_path / name).write_bytes(_damaged(whole, rng))
        try:
            dataset = read_dataset(tmp_path)
        except ValueError as error:
            messages.append(str(error))
        else:
            for track in dataset:
                assert np.isfinite(track.positions).all()
    assert len(messages) > 100
    assert all(str(tmp_path) in message and len(message.splitlines()) == 1 for message in messages)


def test_a_cut_or_garbled_parquet_file_is_refused(tmp_path, info, make_tracks):
    write_dataset(tmp_path, info, make_tracks(4), "parquet")
    whole = (tmp_path / "tracks.parquet").read_bytes()
    assert pq.read_table(tmp_path / "tracks.parquet").num_rows == 80
    cut = [whole[:size] for size in (0, 3, len(whole) // 2, len(whole) - 1)]
    for content in [*cut, whole[:-60] + b"\xff" * 40 + whole[-20:]]:
        (tmp_path / "tracks.parquet").write_bytes(content)
        with pytest.raises(ValueError, match=r"tracks\.parquet must be a whole Parquet file; .*\. Write it again\."):
            read_dataset(tmp_path)
