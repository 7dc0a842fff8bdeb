import os
import pickle

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from ballfg.tracks import read_dataset

HEAD = "trajectory,t,x,y,z\n"
SIGMA_HEAD = "trajectory,t,x,y,z,sigma_x,sigma_y,sigma_z\n"
A = "a,0,0,0,1\na,0.01,0.05,0,1\n"


def _message(folder) -> str:
    with pytest.raises(ValueError, match=r".") as caught:
        read_dataset(folder)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_dataset_streams_again_and_again(make_folder):
    dataset = read_dataset(make_folder())
    assert len(dataset) == 2
    assert dataset.names == ["000", "b"]
    assert dataset.notes == []
    assert not dataset.has_sigmas
    for _ in range(2):
        first, second = list(dataset)
        assert (first.name, second.name) == ("000", "b")
        assert np.array_equal(first.times, [0, 0.01, 0.02])
        assert np.array_equal(second.positions, [[0, 0.2, 1], [0.05, 0.2, 1.01]])
        assert first.sigmas is None
    assert pickle.loads(pickle.dumps(dataset)).track("b").duration == 0.01


def test_two_loops_at_once_do_not_disturb_each_other(make_folder):
    dataset = read_dataset(make_folder())
    assert [(a.name, b.name) for a in dataset for b in dataset] == [
        ("000", "000"), ("000", "b"), ("b", "000"), ("b", "b"),
    ]  # fmt: skip


def test_a_track_by_name(make_folder):
    dataset = read_dataset(make_folder())
    assert len(dataset.track("000")) == 3
    with pytest.raises(ValueError, match=r"name must be one of the 2 trajectories of .*; got '0'. See names."):
        dataset.track("0")


def test_sigmas_are_read_and_other_columns_noted(make_folder):
    text = "colour,sigma_z,sigma_y,sigma_x,z,y,x,t,trajectory\nred,.3,.2,.1,1,0,0,0,a\nred,.3,.2,.1,1,0,0,0.01,a\n"
    dataset = read_dataset(make_folder(text))
    assert dataset.notes == ["tracks.csv: column 'colour' ignored"]
    assert dataset.has_sigmas
    assert np.array_equal(dataset.track("a").sigmas, [[0.1, 0.2, 0.3], [0.1, 0.2, 0.3]])


@pytest.mark.parametrize(
    "text",
    [
        "\ufeff" + HEAD + A,
        (HEAD + A).replace("\n", "\r\n"),
        (HEAD + A).replace("\n", "\r"),
        HEAD + "\n" + A.replace("\n", "\n\n"),
        HEAD + A.rstrip("\n"),
        HEAD + "a, 0 ,+0,-0.0,1e0\na,1.0E-2,.05,0.,01\n",
    ],
    ids=["byte order mark", "CRLF", "CR", "empty lines", "no last newline", "ways to write numbers"],
)
def test_usual_variants_of_csv_are_read(make_folder, text):
    track = read_dataset(make_folder(text)).track("a")
    assert np.array_equal(track.times, [0, 0.01])
    assert np.array_equal(track.positions, [[0, 0, 1], [0.05, 0, 1]])


def test_names_with_commas_and_quotes(make_folder):
    text = HEAD + '"a,b ""c""",0,0,0,1\n"a,b ""c""",0.01,0,0,1\n'
    dataset = read_dataset(make_folder(text, labels='trajectory,group\n"a,b ""c""",x\n'))
    assert dataset.names == ['a,b "c"']
    assert dataset.track('a,b "c"').labels == {"group": "x"}


@pytest.mark.parametrize("name", ["NA", "null", "007", "1e3", "nan", " a "])
def test_names_stay_as_they_are_written(make_folder, name):
    dataset = read_dataset(make_folder(HEAD + A.replace("a,", f"{name},"), labels=f"trajectory,speed\n{name},3\n"))
    assert dataset.names == [name]
    assert dataset.track(name).labels == {"speed": 3.0}


def test_rows_out_of_order_are_sorted_with_a_note(make_folder):
    dataset = read_dataset(make_folder(HEAD + "a,0.02,2,0,0\na,0,0,0,0\na,0.01,1,0,0\nb,0,0,0,0\nb,0.01,0,0,0\n"))
    assert dataset.notes == ["rows of 1 trajectory were not in time order: sorted ('a')"]
    assert np.array_equal(dataset.track("a").positions[:, 0], [0, 1, 2])


def test_interleaved_trajectories_are_regrouped(make_folder):
    rows = [f"{name},{i / 100},{i},{j},0" for i in range(50) for j, name in enumerate("cab")]
    dataset = read_dataset(make_folder(HEAD + "\n".join(rows) + "\n"))
    assert dataset.notes == ["tracks.csv: the rows of different trajectories interleave: regrouped at each pass"]
    for _ in range(2):
        tracks = list(dataset)
        assert [track.name for track in tracks] == ["c", "a", "b"]
        for j, track in enumerate(tracks):
            assert np.array_equal(track.times, np.arange(50) / 100)
            assert np.array_equal(track.positions[:, 0], np.arange(50))
            assert (track.positions[:, 1] == j).all()


def test_shuffled_equals_sorted_over_many_blocks(make_folder, tmp_path):
    rng = np.random.default_rng(3)
    rows = [f"s{k},{i / 100},{rng.normal()!r},0,{k}" for k in range(40) for i in range(400)]
    ordered = read_dataset(make_folder(HEAD + "\n".join(rows)))
    (tmp_path / "small").rename(tmp_path / "ordered")
    ordered = read_dataset(tmp_path / "ordered")
    shuffled = read_dataset(make_folder(HEAD + "\n".join(rng.permutation(rows))))
    assert "rows of 40 trajectories were not in time order" in shuffled.notes[-1]
    assert "and 37 more" in shuffled.notes[-1]
    assert sorted(shuffled.names) == sorted(ordered.names)
    found = {track.name: track for track in shuffled}
    for track in ordered:
        assert np.array_equal(found[track.name].times, track.times)
        assert np.array_equal(found[track.name].positions, track.positions)


def test_exact_repeats_are_dropped_and_counted(make_folder):
    text = HEAD + "a,0,0,0,0\na,0,0,0,0\na,0.01,1,0,0\nb,0,0,0,0\nb,0.01,0,0,0\nb,0,0,0,0\n"
    dataset = read_dataset(make_folder(text))
    assert dataset.notes == ["2 exact repeats dropped", "rows of 1 trajectory were not in time order: sorted ('b')"]
    assert [len(track) for track in dataset] == [2, 2]


def test_near_rows_at_one_stamp_are_averaged_with_a_note(make_folder):
    dataset = read_dataset(make_folder(HEAD + "a,0,0,0,0\na,0.01,1,0,0\na,0.01,1.02,0,0.02\na,0.02,2,0,0\n"))
    assert dataset.notes == ["1 stamp with different rows, up to 2.8 cm apart: averaged ('a' at t=0.01)"]
    assert np.allclose(dataset.track("a").positions[1], [1.01, 0, 0.01], atol=1e-15)


@pytest.mark.parametrize("apart", [0.099, 0.101])
def test_rows_at_one_stamp_are_one_ball_within_a_tenth_of_a_metre(make_folder, apart):
    folder = make_folder(HEAD + f"a,0,0,0,0\na,0.01,1,0,0\na,0.01,{1 + apart},0,0\na,0.02,2,0,0\n")
    if apart < 0.1:
        assert np.allclose(read_dataset(folder).track("a").positions[1], [1.0 + apart / 2, 0, 0])
    else:
        with pytest.raises(ValueError, match=r"one position for each time; got two, 0\.101 m apart"):
            read_dataset(folder)


def test_near_rows_with_sigmas_are_weighted(make_folder):
    rows = "a,0,0,0,0,.01,.01,.01\na,0,0.05,0,0,.02,.02,.02\na,1,0,0,0,.01,.01,.01\n"
    track = read_dataset(make_folder(SIGMA_HEAD + rows)).track("a")
    # Weights 4 : 1, so x = 0.05 / 5; chi2 = (0.01 / 0.01)^2 + (0.04 / 0.02)^2 = 5 with one degree of freedom.
    assert np.allclose(track.positions[0], [0.01, 0, 0], atol=1e-15)
    alone = 0.01 / np.sqrt(1.25)
    assert np.allclose(track.sigmas[0], [alone * np.sqrt(5), alone, alone], rtol=1e-12)


CELLS = "must be a number with a decimal point"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a" * 65_537, "tracks.csv, line 1: the line of column names must have at most 65536 bytes; it has more."),
        (HEAD + A + "b,0,1,2," + "3" * 262_144 + "\n", "tracks.csv, line 4: must have at most 262144 characters"),
        (
            HEAD + A + "b" * 201 + ",0,1,2,3\n",
            "line 4, column 'trajectory': must be printable text of one line, 1 to 200",
        ),
        (HEAD + A + "b\u202ec,0,1,2,3\n", r"got 'b\u202ec'. Fill in a name."),
        ("", "tracks.csv: must begin with a line of column names; got an empty file or line. Add the header."),
        (HEAD.strip(), "tracks.csv: must hold tracks; got a header without rows. Add the measurements."),
        (HEAD, "tracks.csv: must hold tracks; got a header without rows. Add the measurements."),
        ("trajectory,t,x,y\na,0,0,0\n", "column 'z' is missing; expected trajectory,t,x,y,z, got 'trajectory,t,x,y'."),
        ("trajectory,time,x,y,z\n" + A, "column 't' is missing; expected trajectory,t,x,y,z, got 'trajectory,time,x"),
        ("trajectory,time,x,y,z\n" + A, "Add or rename the column. Did you mean 'time'?"),
        ("trajectory,t, x,y,z\n" + A, "column 'x' is missing"),
        ("trajectory,t, x,y,z\n" + A, "Did you mean ' x'?"),
        ((HEAD + A).replace(",", ";"), "Cells must be separated by commas."),
        ("trajectory,t,x,y,z,x\na,0,0,0,1,1\n", "column 'x' must appear once; got 'trajectory,t,x,y,z,x'. Rename one"),
        (
            "trajectory,t,x,y,z,sigma_x\na,0,0,0,1,1\n",
            "sigma columns must be all three or none; sigma_y, sigma_z missing",
        ),
        (
            HEAD + A + "b,0,1,2\n",
            "line 4: must have 5 cells, one for each column of the header; got 4. Complete the line",
        ),
        (HEAD + A + "b,0,1,2,3,4\n", "line 4: must have 5 cells, one for each column of the header; got 6."),
        (HEAD + "\n" + A + "b,0,1,foo,2\n", f"line 5, column 'y': {CELLS}; got 'foo'. Correct it or delete the line."),
        (HEAD + 'a,0,"1,5",0,0\n', f"line 2, column 'x': {CELLS}; got '1,5'."),
        (HEAD + A + "b,0,1,2,\n", f"line 4, column 'z': {CELLS}; got an empty cell."),
        (HEAD + A + "b,nan,1,2,3\n", "line 4, column 't': must be finite; got nan. Delete the line: a missing sample"),
        (HEAD + A + "b,0,1,2,-inf\n", "line 4, column 'z': must be finite; got -inf."),
        (HEAD + A + "b,0,1,2,1e999\n", "line 4, column 'z': must be finite; got inf."),
        (HEAD + A + "b,0,1,2,-1e200\n", "line 4, column 'z': must be at most 1e+100 in size; got -1e+200. Delete the"),
        (
            SIGMA_HEAD + "a,0,0,0,1,1,1,inf\n",
            "line 2, column 'sigma_z': must be a standard deviation of 1e-09 to 1e+06 m",
        ),
        (
            SIGMA_HEAD + "a,0,0,0,1,2,2,2\na,.01,0,0,1,2,2,2\n",
            "sigmas must be in m, their median at most 1; got 2. The",
        ),
        (HEAD + A + ",0,1,2,3\n", "line 4, column 'trajectory': must be printable text of one line, "),
        (HEAD + A + '"b\nc",0,1,2,3\n', "line 4, column 'trajectory': must be printable text of one line, "),
        (
            HEAD + A + '"b,0,1,2,3\nb,0,1,2,3\n',
            "line 4: must be a row of comma-separated cells; unexpected end of data.",
        ),
        ((HEAD + A).encode() + b"\xe9,0,1,2,3\n", "line 4: must be UTF-8 text; got bytes of another encoding. Save it"),
        ((HEAD + A).encode("utf-16"), "line 1: must be UTF-8 text; got bytes of another encoding."),
        ((HEAD + A).encode("utf-16-le"), "line 1: must be UTF-8 text; got bytes of another encoding."),
        (
            SIGMA_HEAD + "a,0,0,0,1,1,1,1\na,1,0,0,1,1,0,1\n",
            "line 3, column 'sigma_y': must be a standard deviation of 1e-09 to 1e+06 m; got 0.",
        ),
        (
            SIGMA_HEAD + "a,0,0,0,1,1,1,-1\n",
            "line 2, column 'sigma_z': must be a standard deviation of 1e-09 to 1e+06 m; got -1.",
        ),
        (
            HEAD + A + "b,0,1,2,3\n",
            "line 4: trajectory 'b' must have at least two samples at different times; got one.",
        ),
        (HEAD + A + "b,0,1,2,3\nb,0,1,2,3\n", "line 4: trajectory 'b' must have at least two samples"),
        (
            HEAD + A + "b,0,1,2,3\nb,0.01,0,0,0\n\nb,0,1,2,4\n",
            "lines 4 and 7: trajectory 'b' must have one position for each time; got two, 1 m apart, at t=0.0.",
        ),
    ],
)
def test_a_bad_table_is_named(make_folder, text, message):
    folder = make_folder(text)
    got = _message(folder)
    assert got.startswith(str(folder / "tracks.csv"))
    assert message in got


@pytest.mark.parametrize(
    ("scale", "stamps", "yaml", "message"),
    [
        (1000, 0.01, "", "a track at most 250 m long; got 950. The unit is probably mm: divide by 1000."),
        (
            100,
            0.0001,
            "",
            "got a median speed of 5e+04 m/s, above that of sound. The unit of x, y, z is probably mm or",
        ),
        (1, 10, "", "stamps 1e-06 to 1 s apart; got a median step of 10. The unit is probably ms: divide by 1000."),
        (1, 1e4, "", "The unit is probably us: divide by 1e+06."),
        (1, 1e7, "", "The unit is probably ns: divide by 1e+09."),
        (1, 1.0, "rate: 1000\n", "near 1/1000 s (rate); got a median step of 1. The unit is probably ms: divide by"),
        (1, 0.01, "rate: 0.1\n", "near 1/0.1 s (rate); got a median step of 0.01. Convert it to s, or correct rate"),
        (1e-6, 1e-7, "", "got a median step of 1e-07. Convert it to s."),
    ],
)
def test_other_units_are_suspected(make_folder, scale, stamps, yaml, message):
    rows = [f"a,{i * stamps!r},{i * 0.05 * scale},0,0" for i in range(20)]
    text = "name: a\nframe: {up: z, table_height: 0}\nball: {radius: 0.02, mass: 0.0027}\n" + yaml
    got = _message(make_folder(HEAD + "\n".join(rows), text))
    assert "tracks.csv, line 2: trajectory 'a': " in got
    assert message in got


def test_a_far_origin_is_refused(make_folder):
    got = _message(make_folder(HEAD + "a,0,5000,0,0\na,0.01,5000,0,0\n"))
    assert (
        "within 1000 m of the origin; got 5000. The unit is probably mm (divide by 1000), or the origin is far" in got
    )


def test_an_error_at_the_end_of_a_large_file_is_found_before_any_track(make_folder):
    rows = [f"s{k},{i / 100},0.5,0.25,{k % 7}" for k in range(100) for i in range(200)]
    text = HEAD + "\n".join(rows) + "\nlast,0,0,0,zero\n"
    assert f"line 20002, column 'z': {CELLS}; got 'zero'" in _message(make_folder(text))


def test_a_changed_file_is_refused(make_folder):
    folder = make_folder()
    dataset = read_dataset(folder)
    os.utime(folder / "tracks.csv", (1, 1))
    with pytest.raises(ValueError, match=r"must not change while it is in use; it did\. Call read_dataset again\."):
        next(iter(dataset))


@pytest.mark.parametrize(
    ("present", "message"),
    [
        ((), "must hold dataset.yaml; got an empty folder. Add it: name, frame and ball (docs/tracks.md)."),
        (("tracks.csv",), "must hold dataset.yaml; got tracks.csv."),
        (("dataset.yaml",), "must hold tracks.csv or tracks.parquet; got dataset.yaml. Add it: trajectory,t,x,y,z"),
        (
            ("dataset.yaml", "detections.csv"),
            "it holds sightings of cameras alone. They serve 'ballfg estimate --from det",
        ),
    ],
)
def test_missing_files_are_named(tmp_path, present, message):
    for name in present:
        (tmp_path / name).touch()
    with pytest.raises(FileNotFoundError) as caught:
        read_dataset(tmp_path)
    assert message in str(caught.value)


def test_a_folder_must_be_there_and_be_one(make_folder, tmp_path):
    with pytest.raises(
        FileNotFoundError, match=r"folder must exist; .*nowhere does not\. Give the folder of a dataset"
    ):
        read_dataset(tmp_path / "nowhere")
    with pytest.raises(ValueError, match=r"folder must be a folder; .*tracks\.csv is a file\. Give the folder that"):
        read_dataset(make_folder() / "tracks.csv")


def test_two_tables_are_refused(make_folder):
    folder = make_folder()
    (folder / "tracks.parquet").touch()
    assert "must hold one table of tracks; got tracks.csv and tracks.parquet. Delete one of them." in _message(folder)


PARQUET = {"trajectory": ["a", "a"], "t": [0.0, 0.01], "x": [0.0, 0.0], "y": [0.0, 0.0], "z": [1.0, 1.0]}


@pytest.mark.parametrize(
    "change",
    [
        {"trajectory": pa.array([7, 7])},
        {"trajectory": pa.array(["7", "7"]).dictionary_encode()},
        {"trajectory": pa.array(["7", "7"], pa.large_string()), "z": pa.array([1, 1])},
        {"trajectory": pa.array(["7", "7"]), "y": pa.array([0, 0], pa.float32())},
    ],
)
def test_parquet_types_that_mean_the_same_are_read(make_folder, change):
    folder = make_folder(tracks=None)
    pq.write_table(pa.table({**PARQUET, **change}), folder / "tracks.parquet")
    assert np.array_equal(read_dataset(folder).track("7").positions, [[0, 0, 1], [0, 0, 1]])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"x": ["0", "1"]}, "tracks.parquet, column 'x': must hold numbers; got type string. Convert it to float64"),
        ({"t": pa.array([0, 1], pa.timestamp("ms"))}, "column 't': must hold numbers; got type timestamp[ms]."),
        ({"x": [0.0, None]}, "tracks.parquet, row 2, column 'x': must be finite; got nan."),
        (
            {"trajectory": ["a", None]},
            "tracks.parquet, row 2, column 'trajectory': must be printable text of one line, ",
        ),
        ({"trajectory": [b"\xff", b"a"]}, "tracks.parquet: cannot be read as a table of tracks; Invalid UTF8"),
        ({"t": [0.0, 0.0], "x": [0.0, 1.0]}, "tracks.parquet, rows 1 and 2: trajectory 'a' must have one position"),
    ],
)
def test_a_bad_parquet_file_is_named(make_folder, change, message):
    folder = make_folder(tracks=None)
    pq.write_table(pa.table({**PARQUET, **change}), folder / "tracks.parquet")
    assert message in _message(folder)


def test_a_parquet_file_that_is_none(make_folder):
    folder = make_folder(tracks=None)
    (folder / "tracks.parquet").write_bytes(b"trajectory,t,x,y,z\n")
    assert "tracks.parquet must be a whole Parquet file;" in _message(folder)
