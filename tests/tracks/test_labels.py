import pytest

from ballfg.tracks import read_dataset


def test_numbers_and_text_are_told_apart(make_folder):
    labels = "trajectory,spin_x,group,wheel,colour,split\n000,1.5,1,1200,red,7\nb,,2,3,blue,\n"
    dataset = read_dataset(make_folder(labels=labels))
    assert dataset.label_names == ["spin_x", "group", "wheel", "colour", "split"]
    assert dataset.track("000").labels == {"spin_x": 1.5, "group": "1", "wheel": 1200.0, "colour": "red", "split": "7"}
    assert dataset.track("b").labels == {"group": "2", "wheel": 3.0, "colour": "blue"}


def test_a_column_with_one_text_is_text(make_folder):
    dataset = read_dataset(make_folder(labels="trajectory,serial\n000,12\nb,12a\n"))
    assert [track.labels["serial"] for track in dataset] == ["12", "12a"]


def test_tracks_without_a_label_row_are_noted(make_folder):
    dataset = read_dataset(make_folder(labels="trajectory,speed\nb,3\n"))
    assert dataset.notes == ["labels.csv: 1 of 2 trajectories unlabelled"]
    assert [track.labels for track in dataset] == [{}, {"speed": 3.0}]


@pytest.mark.parametrize(
    ("labels", "partial"),
    [
        ("trajectory,spin_x,spin_y,spin_z\n000,1,2,3\nb,,2,3\n", 1),
        ("trajectory,spin_y\n000,2\nb,5\n", 2),
        ("trajectory,spin_x,spin_y,spin_z\n000,1,2,3\nb,,,\n", 0),
        ("trajectory,group\n000,spin\nb,none\n", 0),
    ],
)
def test_a_part_of_a_spin_is_noted(make_folder, labels, partial):
    dataset = read_dataset(make_folder(labels=labels))
    rest = "trajectories with only a part of spin_x,spin_y,spin_z: their spin is not used"
    assert dataset.notes == ([f"labels.csv: {partial} of 2 {rest}"] if partial else [])
    labelled = [track.name for track in dataset if track.spin_label is not None]
    assert labelled == (["000"] if "spin_x" in labels else [])


@pytest.mark.parametrize(
    ("labels", "message"),
    [
        ("", "labels.csv: must begin with a line of column names; got an empty file or line."),
        (
            "name,speed\nb,3\n",
            "labels.csv: column 'trajectory' is missing; got 'name,speed'. Add or rename the column. Did",
        ),
        (
            "trajectory,speed,speed\nb,3,3\n",
            "labels.csv: column 'speed' must appear once; got 'trajectory,speed,speed'.",
        ),
        (
            "trajectory,speed,\nb,3,3\n",
            "labels.csv, line 1: the name of each column must be printable text of one line, ",
        ),
        ("trajectory,speed\nb\n", "labels.csv, line 2: must have 2 cells, one for each column of the header; got 1."),
        ("trajectory,speed\nb,3\nc,3\n", "labels.csv, line 3: trajectory 'c' must have a track; there is none of that"),
        ("trajectory,speed\n00,3\n", "Names are compared as text, zeros included. Did you mean '000'?"),
        (
            "trajectory,speed\nb,3\n\n000,1\nb,4\n",
            "line 5: trajectory 'b' must have one row; line 2 is another. Delete one",
        ),
        (
            "trajectory,speed\nb,fast\n",
            "labels.csv, line 2, column 'speed': must be a number; got 'fast'. Correct it, or",
        ),
        ("trajectory,spin_x\n000,1\nb,nan\n", "labels.csv, line 3, column 'spin_x': must be a number; got 'nan'."),
        ("trajectory,spin_x\n000,1\nb,1e999\n", "labels.csv, line 3, column 'spin_x': must be a number; got '1e999'."),
        (b"trajectory,group\nb,caf\xe9\n", "labels.csv, line 2: must be UTF-8 text;"),
    ],
)
def test_bad_labels_are_named(make_folder, labels, message):
    folder = make_folder(labels=labels)
    with pytest.raises(ValueError, match=r".") as caught:
        read_dataset(folder)
    assert str(caught.value).startswith(str(folder / "labels.csv"))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def _spins(count: int, absurd: int) -> tuple[str, str]:
    """tracks.csv and labels.csv of some shots, the first ones with a spin that no ball has."""
    samples = (f"{k},{0.01 * i},{0.03 * i},0,1\n" for k in range(count) for i in range(5))
    rows = (f"{k},{-2231 if k < absurd else 10 * k},1,2\n" for k in range(count))
    return "trajectory,t,x,y,z\n" + "".join(samples), "trajectory,spin_x,spin_y,spin_z\n" + "".join(rows)


def test_a_spin_that_no_ball_has_is_set_aside_with_a_note(make_folder):
    tracks, labels = _spins(20, 2)
    dataset = read_dataset(make_folder(tracks=tracks, labels=labels))
    assert dataset.notes == [
        f"labels.csv, line {line}: spin_x -2231 is not within 2000 rad/s, as the spin of every ball: "
        "the label is set aside"
        for line in (2, 3)
    ]
    spins = [track.spin_label for track in dataset]
    assert [spin is None for spin in spins] == [True] * 2 + [False] * 18
    assert dataset.track("7").spin_label.tolist() == [70.0, 1.0, 2.0]


def test_more_than_a_tenth_of_such_spins_is_refused(make_folder):
    tracks, labels = _spins(20, 3)
    rule = r"labels.csv, line 4, column 'spin_x': must be within 2000 rad/s, .*; got -2231. Correct it, or leave"
    with pytest.raises(ValueError, match=rule):
        read_dataset(make_folder(tracks=tracks, labels=labels))
