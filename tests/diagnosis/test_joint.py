"""Two rooms with one ball: what is the ball's is found in both together, what one room has is that room's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ballfg.diagnosis import diagnose_jointly, write_report
from ballfg.diagnosis.report.predictions import median_shot
from ballfg.dynamics import EFFECTS, load_model, nominal_model
from ballfg.simulation import SimulationConfig, parse_effects, write_simulation
from ballfg.tracks import read_dataset, write_dataset

GAIN, TILT = 1.0, 0.04
TRACKS = 6
"""Of each room."""
LONG = 0.8
"""s of each track: time for a bounce."""
CATALOGUE = [EFFECTS[name] for name in ("drag_spin", "frame_tilt")]


@pytest.fixture(scope="module")
def rooms(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rooms")
    effects = {"level": (), "leaning": (f"frame_tilt.x={TILT}",)}
    for seed, (name, own) in enumerate(effects.items()):
        ball = (f"drag_spin.gain={GAIN}",)
        config = SimulationConfig(tracks=TRACKS, rate=45.0, seed=seed, undeclared=parse_effects((*ball, *own)))
        write_simulation(folder / f"whole-{name}", config)
        whole = read_dataset(folder / f"whole-{name}")
        write_dataset(folder / name, replace(whole.info, name=name), (track.until(LONG) for track in whole))
    return [read_dataset(folder / name) for name in effects]


@pytest.fixture(scope="module")
def joint(rooms):
    return diagnose_jointly(rooms, nominal_model(), catalogue=CATALOGUE)


def test_what_both_rooms_want_is_the_balls_and_what_one_wants_is_its_own(joint):
    found = {finding.name: finding for finding in joint.whole.findings}
    assert set(found) == {"drag_spin", "frame_tilt_by_group"}
    gain = found["drag_spin"].parameters["gain"]
    assert gain.value == pytest.approx(GAIN, abs=4 * gain.sigma)
    told = found["frame_tilt_by_group"].parameters
    assert told["x[leaning]"].value == pytest.approx(TILT, abs=0.005)
    assert told["x[level]"].value == pytest.approx(0.0, abs=0.005)
    assert joint.whole.remarks[:2] == (
        "drag_spin: of the ball, wanted alike in all rooms.",
        "frame_tilt_by_group: of single rooms.",
    )


def test_labels_of_all_rooms_are_judged_each_in_its_own(joint):
    judged = joint.whole.labels
    assert {verdict.track.partition("/")[0] for verdict in judged.verdicts} == {"level", "leaning"}
    assert len(judged.verdicts) == 2 * TRACKS
    assert judged.contradicted == ()
    assert judged.p_all_right > 0.5


def test_the_balls_model_has_nothing_of_a_room_and_each_room_has_its_own(joint):
    assert "drag_spin" in joint.whole.model.flight
    assert "frame_tilt" not in joint.whole.model.measurement
    assert joint.whole.model.trained is None
    assert joint.whole.model.variations == {}
    tilts = {name: float(model.measurement["frame_tilt"].x.detach()) for name, model in joint.rooms.items()}
    assert tilts["leaning"] == pytest.approx(TILT, abs=0.005)
    assert tilts["level"] == pytest.approx(0.0, abs=0.005)


def test_predictions_get_better_in_both_rooms(joint):
    assert joint.whole.after.prediction_rmse_mm < 0.7 * joint.whole.before.prediction_rmse_mm
    assert len(joint.whole.before.by_track) == len(joint.whole.after.by_track)


def test_a_shot_is_compared_with_itself_and_not_with_its_namesake_of_another_room(joint):
    """Tracks of both rooms have the same names."""
    shot = median_shot(joint.whole.before, joint.whole.after, True)
    np.testing.assert_array_equal(shot.before.measured, shot.after.measured)
    names = [path.name for path in joint.whole.after.paths]
    assert len(set(names)) == len(names)


def test_the_noise_of_a_room_is_that_about_its_corrected_model(joint):
    """No motion is random. What the declared model lacks would look like 0.1 m/s^2/sqrt(Hz) and make intervals wide."""
    for model in joint.rooms.values():
        assert model.noise.acceleration < 0.03
    assert 0.6 < joint.whole.after.nis < 1.6


def test_rooms_without_labels_have_each_their_own_spins(rooms, tmp_path):
    for room in rooms:
        write_dataset(tmp_path / room.info.name, room.info, (replace(track, labels={}) for track in room))
    bare = [read_dataset(tmp_path / room.info.name) for room in rooms]
    found = diagnose_jointly(bare, nominal_model(), catalogue=[EFFECTS["buoyancy"]])
    groups = {name: model.spins.groups for name, model in found.rooms.items()}
    assert {name: set(own) for name, own in groups.items()} == {"level": {"level"}, "leaning": {"leaning"}}
    assert [own[name].tracks for name, own in groups.items()] == [TRACKS, TRACKS]


@pytest.mark.usefixtures("blank_pictures")
def test_the_folder_holds_the_ball_and_the_rooms(joint, tmp_path):
    write_report(joint.whole, tmp_path / "out", joint.rooms)
    files = {path.name for path in (tmp_path / "out").iterdir() if path.is_file()}
    assert files == {"report.json", "report.html", "model.yaml", "model.level.yaml", "model.leaning.yaml"}
    ball, room = (load_model(tmp_path / "out" / name) for name in ("model.yaml", "model.leaning.yaml"))
    assert "frame_tilt" not in ball.measurement
    assert room.noise == joint.rooms["leaning"].noise
    np.testing.assert_allclose(room.measurement["frame_tilt"].x.detach(), TILT, atol=0.005)


def test_rooms_need_names_of_their_own(rooms):
    with pytest.raises(ValueError, match="datasets must be two or more, each with a name of its own; got level, level"):
        diagnose_jointly([rooms[0], rooms[0]], nominal_model())
