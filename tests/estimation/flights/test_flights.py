"""Flights in recordings with their truth, in measured tracks, and in commands."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ballfg as bf
from ballfg.dynamics import nominal_model
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.flights.dataset import error_ratios, flies_throughout, flights_of, in_flight, pieces_of
from ballfg.estimation.flights.decode import decode
from ballfg.estimation.flights.estimates import estimated
from ballfg.estimation.flights.labels import ANY_BALL, MARGIN, MOST, falls_throughout, label_samples, scatter
from ballfg.estimation.flights.modes import HANDLED, SWAYED, _wandered
from ballfg.estimation.result import Label
from ballfg.estimation.segmentation.bank import HYPOTHESIS, LOGGED, Scene
from ballfg.estimation.segmentation.log import chain, compact
from ballfg.estimation.segmentation.physics import physics_of
from ballfg.simulation import SimulationConfig, simulate
from ballfg.tracks import TABLE_TENNIS, Track, read_dataset, write_dataset
from ballfg.tracks.dataset import dataset_in_memory
from ballfg.tracks.info import DatasetInfo
from tests.commands import status
from tests.estimation.flights.found import Count, take
from tests.estimation.flights.recordings import recording
from tests.places import DATA

PHYSICS = physics_of(nominal_model())
INFO = DatasetInfo("recordings", 0.0, TABLE_TENNIS)


def test_recordings_are_labelled_and_their_flights_found() -> None:
    """Six recordings; `python -m tests.estimation.flights.found` does hundreds."""
    count = Count()
    for seed in range(9000, 9006):
        take(recording(seed), count)
    assert count.right >= 0.96 * count.samples
    assert count.as_whole >= 0.85 * count.flights
    assert count.false <= 2  # short ones, as a hand begins to move
    assert count.lost <= 0.03 * count.seconds


@pytest.mark.parametrize("name", ["aimy", "ballgun", "robot_rallies", "strokes"])
def test_measured_tracks_are_flights_throughout(name: str) -> None:
    if not (DATA / name).is_dir():
        pytest.skip(f"no measured tracks at {DATA}; set BALLFG_DATA")
    data = read_dataset(DATA / name)
    found = in_flight(data)
    assert found.dataset is data
    assert found.lines == ()


def test_noise_is_that_of_the_samples_whatever_their_stamps() -> None:
    rng = np.random.default_rng(0)
    times = np.cumsum(rng.uniform(0.003, 0.03, 4000))
    path = np.stack((times, np.sin(times), -4.9 * (times % 2.0) ** 2), axis=1)
    sigma = np.array([0.001, 0.003, 0.01])
    np.testing.assert_allclose(scatter(times, path + sigma * rng.standard_normal(path.shape)), sigma, rtol=0.1)


def test_covariance_of_a_hand_is_that_of_its_process() -> None:
    """Against sums over a fine grid of the impulse responses of an exponentially correlated acceleration."""
    for s in (0.01, 0.3, 2.0):
        left = s * (np.arange(20_000) + 0.5) / 20_000
        responses = np.stack((left - (1.0 - np.exp(-left)), 1.0 - np.exp(-left), np.exp(-left)))
        p, v, b = 2.0 * (responses[:, None] * responses).mean(axis=2) * s
        np.testing.assert_allclose(_wandered(s), (p[0], p[1], p[2], v[1], v[2], b[2]), rtol=0.03)


def _thrown(rng: np.random.Generator) -> Track:
    times = np.arange(0.0, 0.8, 0.01)
    height = np.abs(1.0 + 1.5 * times - 4.905 * times**2)
    path = np.stack((3.0 * times, 0.1 * times, height), axis=1)
    return Track(times, path + rng.normal(0.0, 0.002, path.shape))


def test_a_flight_falls_and_a_hand_does_not() -> None:
    rng = np.random.default_rng(1)
    flight = _thrown(rng)
    assert falls_throughout(flight.seconds, flight.positions, np.full(3, 0.002), PHYSICS)
    still = flight.positions.copy()
    still[30:60] = still[30] + rng.normal(0.0, 0.002, (30, 3))
    assert not falls_throughout(flight.seconds, still, np.full(3, 0.002), PHYSICS)
    assert not falls_throughout(flight.seconds, flight.positions, np.full(3, 0.05), PHYSICS)  # noise tells nothing


def test_estimate_of_a_flight_is_that_of_its_estimator() -> None:
    track = _thrown(np.random.default_rng(2))
    estimator = bf.Smoother(nominal_model(), 0.0)
    alone, found = estimator.estimate(track), estimated(estimator, track)
    np.testing.assert_array_equal(found.states, alone.states)
    np.testing.assert_array_equal(found.covariances, alone.covariances)
    assert (found.labels == Label.FLIGHT).all()


def test_what_is_no_flight_stays_as_measured() -> None:
    one = recording(9002, kind="juggled")
    estimator = bf.Smoother(nominal_model(), 0.0)
    found = estimated(estimator, one.track)
    held = found.labels == Label.HELD
    assert held.any()
    np.testing.assert_array_equal(found.states[held, :3], one.track.positions[held])
    np.testing.assert_allclose(
        found.sigmas[held, :3], np.broadcast_to(estimator.settings.position_noise, (held.sum(), 3))
    )
    piece = pieces_of(label_samples(one.track, PHYSICS))[1]
    alone = estimator.estimate(one.track.between(*one.track.times[[piece.first, piece.last]]))
    np.testing.assert_array_equal(found.states[piece.first : piece.last + 1], alone.states)
    assert found.status is bf.Status.OK
    assert len(found.hits) == 0
    assert "of the samples are flight" in found.notes[0]
    assert set(found.columns["label"]) <= {"flight", "held", "rolling", "resting", "lost"}


def test_nothing_that_flies() -> None:
    found = bf.estimate(recording(9006, kind="held").track)
    assert found.status is bf.Status.NO_FLIGHT
    assert not found.status.failed
    assert bf.flights(recording(9006, kind="held").track) == []


def test_flights_say_why_they_begin_and_end() -> None:
    one = recording(9005, kind="caught")
    found = bf.flights(one.track)
    assert [flight.labels["recording"] for flight in found] == [one.track.name] * len(found)
    assert {flight.labels["begins"] for flight in found} == {"thrown"}
    assert {flight.labels["ends"] for flight in found} <= {"caught", "end"}
    whole = _thrown(np.random.default_rng(3))
    assert flights_of(whole, PHYSICS) == [whole]


def test_a_low_pass_shows() -> None:
    for low_pass, smoothed in ((None, False), (6.0, True)):
        one = recording(9002, low_pass, "juggled")
        found = in_flight(dataset_in_memory(INFO, [one.track]))
        assert any("a filter smoothed" in line for line in found.lines) is smoothed
        assert len(error_ratios(one.track, label_samples(one.track, PHYSICS)))


def test_positions_that_a_tracker_holds_for_a_stamp_show() -> None:
    """Half of the samples are no measurements; a ball that lies still repeats its place rightly."""
    whole = _thrown(np.random.default_rng(3))
    held = replace(whole, positions=np.repeat(whole.positions[::2], 2, axis=0)[: len(whole)])
    lies = Track(np.arange(100) / 100, np.tile([0.5, 0.0, 0.78], (100, 1)), name="lies")
    once = Track(held.times[::2], held.positions[::2], name=held.name)
    said, cases = {}, {"whole": [whole], "held": [held], "without repeats": [once], "lies": [whole, lies]}
    for name, tracks in cases.items():
        found = in_flight(dataset_in_memory(INFO, tracks))
        said[name] = [line for line in found.lines if "a tracker held" in line]
    assert said.pop("held") == [
        "50 % of the positions in flight repeat the one before them: a tracker held or rounded them; leave the repeats "
        "out, or velocities lag and sigmas are too small"
    ]
    assert not any(said.values())


def test_gaps_that_someone_filled_show() -> None:
    """A line across a gap is no measurement; a measured flight, a rest and a single sample are silent."""
    whole = _thrown(np.random.default_rng(3))

    def without(first: int, last: int) -> Track:
        gone = np.arange(first, last)
        known = np.delete(np.arange(len(whole)), gone)
        lines = [np.interp(whole.times, whole.times[known], axis[known]) for axis in whole.positions.T]
        return replace(whole, positions=np.stack(lines, axis=1))

    lies = Track(np.arange(100) / 100, np.tile([0.5, 0.0, 0.78], (100, 1)), name="lies")
    cases = {"whole": [whole], "lies": [whole, lies], "filled": [without(12, 20)], "one": [without(12, 13)]}
    said = {}
    for name, tracks in cases.items():
        found = in_flight(dataset_in_memory(INFO, tracks))
        said[name] = [line for line in found.lines if "gaps were filled in" in line]
    (line,) = said.pop("filled")
    assert line.startswith(f"{100 * 8 / len(whole):.0f} % of the positions in flight lie on straight lines")
    assert not any(said.values())


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Four recordings, mostly held."""
    tracks = [
        recording(seed, kind=kind).track for seed, kind in ((1, "held"), (2, "held"), (3, "rolled"), (9, "caught"))
    ]
    write_dataset(tmp_path / "set", replace(INFO, doubts=("the frame may be mirrored",)), tracks)
    return tmp_path / "set"


@pytest.mark.parametrize(
    "command",
    [("noise",), ("predict", "--observe", "0.2", "--out", "{}/p.csv"), ("diagnose", "--out", "{}/d")],
)
def test_commands_that_presume_flight_refuse(
    command: tuple[str, ...], folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name, *options = command
    typed = (name, folder, *(option.format(tmp_path) for option in options))
    assert status(*typed) == 2
    said = capsys.readouterr()
    doubt, share = said.out.splitlines()[:2]
    assert doubt == "doubt: the frame may be mirrored"
    assert "of the samples fall like a ball" in share
    assert "say --anyway" in said.err.splitlines()[-1]


def test_estimates_and_predictions_of_recordings(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert status("estimate", folder, "--out", tmp_path / "s.csv") == 0
    doubt, noise, share = capsys.readouterr().out.splitlines()[:3]
    assert doubt == "doubt: the frame may be mirrored"
    assert "usual one" in noise
    assert share.endswith("of the samples are flight; the rest is held, rolls, rests or is lost")
    assert {line.rpartition(",")[2] for line in (tmp_path / "s.csv").read_text().splitlines()[1:]} >= {"flight", "held"}
    assert status("predict", folder, "--observe", "0.2", "--out", tmp_path / "p.csv", "--anyway") == 0
    names = {line.partition(",")[0] for line in (tmp_path / "p.csv").read_text().splitlines()[1:]}
    assert names <= {flight.name for flight in bf.flights(folder)}


def test_import_of_flights(tmp_path: Path) -> None:
    one = recording(9001, kind="juggled")
    table = np.column_stack((one.track.times, one.track.positions))
    data = bf.import_tracks(table, out=tmp_path / "out", flights=True, table_height=0.0)
    assert all(track.labels["begins"] == "thrown" for track in data)
    assert all(flies_throughout(label_samples(track, PHYSICS)) for track in data)
    assert data.info.imported is not None
    assert "flights" in data.info.imported
    assert read_dataset(tmp_path / "out").info.doubts == data.info.doubts


def test_events_that_no_hypothesis_has_are_dropped() -> None:
    """Of a log of two chains, the one that a hypothesis ends keeps its events and their order."""
    log, kept = np.zeros(6, LOGGED), np.zeros(1, HYPOTHESIS)
    log["before"], log["index"] = [-(2**62), -(2**62), 0, 1, 2, 3], range(6)
    kept["tip"] = 5
    assert compact(kept, log, 6) == 3
    assert chain(kept["tip"][0], log)["index"].tolist() == [1, 3, 5]


def test_without_a_hand_in_it_an_explanation_is_that_of_flights_alone() -> None:
    """So one pass is enough where the best explanation has no hand: of launched balls, and of recordings."""
    agreed = 0
    launched = [shot.track for shot in simulate(SimulationConfig(tracks=25, seed=31))]
    for track in (*launched, *(recording(seed).track for seed in (9100, 9103))):
        scene = Scene(PHYSICS, Surfaces(0.0), replace(ANY_BALL, most=MOST, margin=MARGIN))
        sigmas = np.maximum(np.tile(scatter(track.seconds, track.positions), (len(track), 1)), 1.5e-3)
        given = track.seconds, np.array(track.positions, order="C"), sigmas
        (alone, least), (events, most) = (decode(*given, hands, scene.numbers) for hands in (False, True))
        if not ((events["surface"] >= HANDLED) & (events["surface"] <= SWAYED)).any():
            assert most == pytest.approx(least, abs=1e-9)
            assert events[["kind", "index", "surface"]].tolist() == alone[["kind", "index", "surface"]].tolist()
            agreed += 1
    assert agreed >= 20
