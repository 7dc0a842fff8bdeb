import pickle

import numpy as np
import pytest

from ballfg.estimation import RadarSpeed
from ballfg.tracks import Track
from ballfg.tracks.track import label_text, level_of

T = np.array([0.0, 0.1, 0.3])
P = np.arange(9.0).reshape(3, 3)
SPIN = {"spin_x": 1.0, "spin_y": 2.0, "spin_z": 3.0}


def test_fields_are_copied_to_float64():
    positions = P.astype(np.float32)
    track = Track([0, 1, 2], positions, labels={"speed": 3}, name="a")
    positions[0, 0] = 99
    assert track.times.dtype == track.positions.dtype == np.float64
    assert track.positions[0, 0] == 0
    assert track.labels == {"speed": 3.0}
    assert (len(track), track.duration) == (3, 2.0)


def test_spin_label_needs_all_three():
    assert np.array_equal(Track(T, P, labels=SPIN, name="a").spin_label, [1, 2, 3])
    assert Track(T, P, labels={"spin_x": 1.0}, name="a").spin_label is None
    assert Track(T, P, name="a").spin_label is None


@pytest.mark.parametrize(
    ("label", "text"), [(1.0, "1"), (-2.0, "-2"), (1.5, "1.5"), (1e20, "1e+20"), ("1.0", "1.0"), ("top", "top")]
)
def test_a_whole_number_is_written_as_people_do(label, text):
    assert label_text(label) == text


@pytest.mark.parametrize(
    ("label", "levels", "level"),
    [
        (1.0, ("1", "2"), "1"),
        (1.0, ("1.0", "2.0"), "1.0"),  # of an earlier model file
        ("2.00", ("1", "2"), "2"),
        ("02", ("1", "2"), "2"),
        ("1.0", ("1", "1.0"), "1.0"),
        ("1.10", ("1.1", "1.10"), "1.10"),
        ("1.100", ("1.1", "1.10"), None),
        (1.5, ("1", "2"), None),
        ("top", ("1", "top"), "top"),
        ("3", ("1", "2"), None),
    ],
)
def test_a_label_names_the_level_of_the_same_text_or_whole_number(label, levels, level):
    assert level_of(label, levels) == level


def test_until_keeps_the_first_sample_and_its_spin():
    part = Track(T, P, P + 1, {**SPIN, "group": "g"}, name="a").until(0.1)
    assert np.array_equal(part.times, [0.0, 0.1])
    assert np.array_equal(part.positions, P[:2])
    assert np.array_equal(part.sigmas, P[:2] + 1)
    assert np.array_equal(part.spin_label, [1, 2, 3])


def test_between_without_the_first_sample_leaves_the_spin_out():
    part = Track(T, P, labels={**SPIN, "group": "g"}, name="a").between(0.1, 0.3)
    assert np.array_equal(part.times, [0.1, 0.3])
    assert part.labels == {"group": "g"}


def test_track_survives_pickling():
    copy = pickle.loads(pickle.dumps(Track(T, P, P + 1, SPIN, name="a")))
    assert np.array_equal(copy.positions, P)
    assert copy.labels == SPIN


NAN = np.where(np.arange(9).reshape(3, 3) == 5, np.nan, P)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"name": ""}, "track name must be printable text of one line, "),
        ({"name": "a\nb"}, "got 'a\\nb'. Rename the trajectory."),
        ({"times": []}, "times must have shape (n,) with n >= 1; got (0,)"),
        ({"times": P}, "times must have shape (n,) with n >= 1; got (3, 3)"),
        ({"times": [0.0, 0.2, 0.2]}, "times must be strictly increasing; times[2]=0.2 <= times[1]=0.2. Sort or drop"),
        ({"times": [0.0, np.nan, 1.0]}, "times must be finite; times[1]=nan"),
        ({"positions": P[:2]}, "positions must have shape (3, 3); got (2, 3)"),
        ({"positions": P[:, :2]}, "positions must have shape (3, 3); got (3, 2)"),
        ({"positions": NAN}, "positions must be finite; positions[1, 2]=nan. Drop that sample."),
        ({"positions": [[0, 0, 0], [1, 1], [2, 2, 2]]}, "positions must be an array of numbers;"),
        ({"positions": np.ma.masked_array(P, P > 2.0)}, "an array of numbers; 6 of them are masked. Drop those rows."),
        ({"positions": P + 0j}, "positions must be an array of numbers; got complex numbers."),
        ({"positions": P > 1.0}, "positions must be an array of numbers; got truth values."),
        ({"positions": 1e200 * (P + 1)}, "positions must be within 1e+100; got 1e+200."),
        (
            {"times": np.arange(3).astype("datetime64[s]")},
            "Subtract the first one and divide by np.timedelta64(1, 's').",
        ),
        ({"positions": [["a"] * 3] * 3}, "positions must be an array of numbers; could not convert"),
        ({"sigmas": P[0]}, "sigmas must have shape (3, 3); got (3,)"),
        ({"sigmas": P}, "sigmas must be positive; sigmas[0, 0]=0.0. Give a standard deviation in m"),
        ({"labels": {"trajectory": "a"}}, "label names must be printable text of one line, "),
        ({"labels": {"speed": np.inf}}, "label 'speed' must be a finite number or text; got inf"),
        ({"labels": {"speed": None}}, "label 'speed' must be a finite number or text; got None"),
        ({"labels": {"spin_x": "fast"}}, "label 'spin_x' must be a finite number; got 'fast'"),
    ],
)
def test_bad_fields_are_named(arguments, message):
    with pytest.raises(ValueError, match=r".") as caught:
        Track(**({"name": "a", "times": T, "positions": P} | arguments))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_name_must_be_text():
    with pytest.raises(TypeError, match=r"track name must be text; got int 3\. Put it in quotes"):
        Track(T, P, name=3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"labels": [("speed", 1.0)]}, "labels must be a mapping of names to numbers or text; got list"),
        ({"observations": "ab"}, "observations must be a tuple of Observations; got str 'a'"),
        ({"observations": None}, "observations must be a tuple of Observations; got nothing None"),
        ({"rough": "no"}, "rough must be True or False; got str 'no'"),
    ],
)
def test_fields_of_another_type_are_named(arguments, message):
    with pytest.raises(TypeError) as caught:
        Track(**({"name": "a", "times": T, "positions": P} | arguments))
    assert message in str(caught.value)


def test_one_observation_may_stand_without_a_tuple_and_must_name_a_sample():
    assert Track(T, P, observations=RadarSpeed(2, 5.0, 0.1)).observations[0].state.tolist() == [2]
    with pytest.raises(
        ValueError, match=r"state of 'speed' must be the index of a sample, at most 2; got 3\. Readings"
    ):
        Track(T, P).observed(RadarSpeed(3, 5.0, 0.1))


def test_an_interval_needs_times():
    track = Track(T, P, name="a")
    with pytest.raises(ValueError, match=r"end must be a time in s; got nan\. Correct it\.$"):
        track.until(np.nan)
    with pytest.raises(ValueError, match="start must be a time in s; got nan"):
        track.between(np.nan, 1.0)


def test_an_interval_between_numbers():
    track = Track(T, P, name="a")
    assert len(track.between(np.float32(-1), 10**400)) == 3
    with pytest.raises(TypeError, match=r"end must be a number in s; got str '0\.1'"):
        track.until("0.1")


def test_an_empty_interval_is_refused():
    with pytest.raises(ValueError, match=r"must hold a sample; got \[1, 2\] s while the track covers \[0, 0\.3\] s"):
        Track(T, P, name="a").between(1, 2)
    with pytest.raises(ValueError, match="Widen the interval"):
        Track(T, P, name="a").until(-0.1)
