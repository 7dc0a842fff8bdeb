"""`ballfg predict` as a user meets it: the table, the messages, the exit statuses."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.csv as pa_csv
import pyarrow.parquet as pq
import pytest
import yaml

from ballfg.dynamics import Architecture, build, nominal_model, save_model
from ballfg.dynamics.population import SpinGroup, SpinPopulation
from ballfg.estimation import ConformalScales
from ballfg.estimation.conformal import load_conformal
from ballfg.front import estimator_for
from ballfg.prediction.event_ahead import event_numbers
from ballfg.simulation import SimulationConfig, write_simulation
from ballfg.tracks import Ball, Dataset, Track, read_dataset, write_dataset
from ballfg.tracks.info import DatasetInfo
from tests.commands import printed, refused, status

METHODS = ("smoother", "online", "ekf", "sliding-window")
COLUMNS = ["trajectory", "t", "x", "y", "z", "sigma_x", "sigma_y", "sigma_z"]
TEXT = pa_csv.ConvertOptions(column_types={"trajectory": "string"})


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("cli") / "shots"
    write_simulation(folder, SimulationConfig(tracks=6, rate=60.0, seed=2))
    return read_dataset(folder)


@pytest.mark.parametrize("gust", [0.0, 6.0])
def test_intervals_that_the_tracks_contradict(gust: float, tmp_path: Path) -> None:
    """A gust (m/s^2) that begins after the observed part; six tracks are too few to show their noise."""
    t, tracks = np.arange(60) / 100.0, []
    for seed in range(6):
        p = np.stack((3.0 * t, 0.5 * gust * np.maximum(t - 0.3, 0.0) ** 2, 1.0 + 4.0 * t - 4.905 * t**2), axis=1)
        tracks.append(Track(t, p + np.random.default_rng(seed).normal(0.0, 0.002, p.shape), name=f"{seed}"))
    write_dataset(tmp_path / "throws", DatasetInfo("throws", None, Ball(0.0335, 0.0577), position_noise=0.002), tracks)
    assert (
        "of what was measured there; widen them with --conformal"
        in printed("predict", tmp_path / "throws", "--observe", 0.3, "--out", tmp_path / "p.csv").out
    ) == (gust > 0.0)


@pytest.mark.parametrize("method", METHODS)
def test_one_row_for_each_stamp_after_the_observed_part(dataset: Dataset, tmp_path: Path, method: str) -> None:
    out = tmp_path / "predictions.csv"
    said = printed("predict", dataset.path, "--method", method, "--observe", 0.3, "--out", out)
    notes = [line for line in said.err.splitlines() if not line.endswith("tracks predicted")]  # progress may show
    assert notes == []
    assert said.out.startswith(f"{out}: ")
    assert f"of 6 tracks, from the first 0.3 s of each by {method}" in said.out
    assert "  6 tracks: converged\n" in said.out
    assert "RMSE against what was measured there: " in said.out
    table = pa_csv.read_csv(out, convert_options=TEXT)
    assert table.column_names == COLUMNS
    values = np.stack([table[name].to_numpy() for name in COLUMNS[1:]], axis=1)
    later = [(t.name, t.times > t.times[0] + 0.3 + 1e-9, t) for t in dataset]
    assert table["trajectory"].to_pylist() == [name for name, mask, _ in later for _ in range(mask.sum())]
    np.testing.assert_array_equal(values[:, 0], np.concatenate([t.times[mask] for _, mask, t in later]))
    assert np.isfinite(values).all()
    assert (values[:, 4:] >= dataset.info.position_noise).all()
    errors = values[:, 1:4] - np.concatenate([t.positions[mask] for _, mask, t in later])
    assert (np.abs(errors) < 6 * values[:, 4:]).all()


def test_parquet_and_the_default_method(dataset: Dataset, tmp_path: Path) -> None:
    assert status("predict", dataset.path, "--observe", 0.3, "--method", "smoother", "--out", tmp_path / "p.csv") == 0
    assert status("predict", dataset.path, "--observe", 0.3, "--jobs", 1, "--out", tmp_path / "p.parquet") == 0
    assert pa_csv.read_csv(tmp_path / "p.csv", convert_options=TEXT).equals(pq.read_table(tmp_path / "p.parquet"))


def test_the_same_bytes_twice(dataset: Dataset, tmp_path: Path) -> None:
    for name in ("a", "b"):
        command = ["predict", dataset.path, "--observe", 0.3, "--method", "ekf", "--out", tmp_path / f"{name}.csv"]
        assert status(*command) == 0
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()


def test_tracks_that_end_too_early_are_counted(dataset: Dataset, tmp_path: Path) -> None:
    duration = sorted(t.duration for t in dataset)[2]
    command = ["predict", dataset.path, "--method", "sliding-window", "--out", tmp_path / "p.csv", "--observe"]
    assert "3 of the tracks end within" in printed(*command, duration).out
    said = printed(*command, 60).out
    assert ": 0 positions of 6 tracks" in said
    assert "RMSE" not in said
    assert (tmp_path / "p.csv").read_text() == ",".join(COLUMNS) + "\n"


def test_what_went_wrong_is_said(dataset: Dataset, tmp_path: Path) -> None:
    """One sample tells no velocity: the status is not silent."""
    command = ["predict", dataset.path, "--method", "smoother", "--observe", 1e-3, "--out", tmp_path / "p.csv"]
    assert "  6 tracks: there are too few samples to tell a velocity" in printed(*command).out


@pytest.mark.parametrize(
    ("observe", "message"),
    [
        ("0", "observe must be a positive number of seconds; got 0"),
        ("-0.25", "observe must be a positive number of seconds; got -0.25"),
        ("nan", "observe must be a positive number of seconds; got nan"),
        ("soon", "'--observe'"),
    ],
)
def test_bad_observe(dataset: Dataset, tmp_path: Path, observe: str, message: str) -> None:
    said = printed("predict", dataset.path, "--observe", observe, "--out", tmp_path / "p.csv", status=2)
    assert (said.out, said.err.count("\n")) == ("", 1)
    assert said.err.startswith("ballfg: error: ")
    assert message in said.err
    assert list(tmp_path.iterdir()) == []


def test_missing_observe(dataset: Dataset, tmp_path: Path) -> None:
    assert "--observe" in refused("predict", dataset.path, "--out", tmp_path / "p.csv")


# --- conformal intervals


@pytest.fixture(scope="module")
def calibration(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("calibration") / "shots"
    write_simulation(folder, SimulationConfig(tracks=12, rate=60.0, seed=3))
    return read_dataset(folder)


def sigmas(path: Path) -> np.ndarray:
    table = pa_csv.read_csv(path)
    return np.stack([table[name].to_numpy() for name in COLUMNS[5:]], axis=1)


def test_conformal_sigmas_from_a_dataset_and_from_the_file_that_keeps_them(
    dataset: Dataset, calibration: Dataset, tmp_path: Path
) -> None:
    names = ("plain.csv", "scaled.csv", "again.csv", "scales.yaml")
    plain, scaled, again, scales = (tmp_path / name for name in names)
    command = ["predict", dataset.path, "--observe", 0.3, "--method", "ekf", "--out"]
    assert status(*command, plain) == 0
    said = printed(*command, scaled, "--conformal", calibration.path, "--save-conformal", scales)
    assert (
        "  90 % intervals on the 12 calibration tracks of 'simulated table-tennis': the model's own hold " in said.out
    )
    assert "  90 % intervals on the 6 predicted tracks: the model's own hold " in said.out
    assert f"{scales}: the scales, for --conformal" in said.out
    assert status(*command, again, "--conformal", scales) == 0
    assert again.read_bytes() == scaled.read_bytes()
    found = load_conformal(scales)
    ratios = sigmas(scaled) / sigmas(plain)
    assert set(np.unique(ratios.round(9))) <= {*np.unique(found.scales.round(9)), np.inf}
    infinite = int(np.isinf(ratios).sum())
    note = f"note: {infinite} of {ratios.size} sigmas are infinite: a finite 90 % interval needs 9 calibration tracks"
    assert (note in said.err) == (infinite > 0)
    assert pa_csv.read_csv(scaled).drop(COLUMNS[5:]).equals(pa_csv.read_csv(plain).drop(COLUMNS[5:]))


def test_calibration_tracks_that_fail_are_reported(dataset: Dataset, calibration: Dataset, tmp_path: Path) -> None:
    command = ["predict", dataset.path, "--observe", 1e-3, "--method", "ekf", "--out", tmp_path / "p.csv"]
    assert (
        "  12 calibration tracks: there are too few samples to tell a velocity"
        in printed(*command, "--conformal", calibration.path).out
    )


@pytest.mark.parametrize(
    ("case", "message"),
    [
        ("few", "conformal must hold at least 9 tracks with samples after their first 0.3 s: "),
        ("same", "conformal must hold other tracks than those that are predicted; got "),
        ("table", "conformal must hold tracks with the same surface, table at 0.76 m; got table at 0.5 m in "),
        ("ball", "conformal must hold tracks of the same ball, Ball(radius=0.02, mass=0.0027); got "),
        ("none", "folder must exist; "),
        ("yaml", "section 'conformal' must be a mapping"),
        ("method", "conformal must be calibrated as the tracks are predicted: with 0.3 s observed, by ekf; "),
        ("save", "save_conformal must come with --conformal"),
    ],
)
def test_bad_calibration_tracks(dataset: Dataset, tmp_path: Path, case: str, message: str) -> None:
    folder, out, kept = tmp_path / "made", tmp_path / "out", tmp_path / "kept.yaml"
    out.mkdir()
    write_simulation(folder, SimulationConfig(tracks=8, rate=60.0, seed=3))
    info = yaml.safe_load((folder / "dataset.yaml").read_text())
    if case == "table":
        info["frame"]["table_height"] = 0.5
    if case == "ball":
        info["ball"]["mass"] = 0.003
    (folder / "dataset.yaml").write_text(yaml.safe_dump(info))
    ones = np.ones((1, 3))
    ConformalScales("shots", 0.3, "smoother", np.array([20]), ones, ones, ones).save(kept)
    options: dict[str, list[object]] = {
        "same": ["--conformal", dataset.path],
        "none": ["--conformal", tmp_path / "nothing"],
        "yaml": ["--conformal", folder / "dataset.yaml"],
        "method": ["--conformal", kept],
        "save": ["--save-conformal", out / "scales.yaml"],
    }
    command = ["predict", dataset.path, "--observe", 0.3, "--method", "ekf", "--out", out / "p.csv"]
    said = printed(*command, *options.get(case, ["--conformal", folder]), status=2)
    lines = [line for line in said.err.splitlines() if not line.endswith("tracks predicted")]  # progress may show
    assert (said.out, len(lines)) == ("", 1)
    assert lines[0].startswith("ballfg: error: ")
    assert message in lines[0]
    assert list(out.iterdir()) == []


@pytest.mark.parametrize(
    ("residual", "code", "message"),
    [
        (True, 0, "m.yaml learned from a ball with a radius of 0.0335 m; this one has 0.02 m"),
        (False, 2, "the ball must have the radius 0.0335 m that its networks learned from; got 0.02 m"),
    ],
)
def test_networks_that_learned_from_another_ball_are_a_doubt(
    dataset: Dataset, tmp_path: Path, residual: bool, code: int, message: str
) -> None:
    """Those that correct laws; without laws they are refused."""
    base = nominal_model("tennis")
    small = Architecture.of("mnn+gs", width_flight=2, width_contact=2, depth=1, residual=residual)
    save_model(build(small, radius=base.radius, base=base if residual else None), tmp_path / "m.yaml")
    options = ("--observe", 0.3, "--model", tmp_path / "m.yaml", "--out", tmp_path / "p.csv")
    said = printed("predict", dataset.path, *options, status=code)
    assert message in said.out + said.err


def test_the_group_of_all_tracks(dataset: Dataset, tmp_path: Path) -> None:
    model = nominal_model()
    model.spins = SpinPopulation(
        "player", {name: SpinGroup((0.0, spin, 0.0), (5.0,) * 3, 9) for name, spin in {"a": 200.0, "b": -200.0}.items()}
    )
    save_model(model, tmp_path / "model.yaml")
    unlabelled = tmp_path / "shots"
    write_dataset(unlabelled, dataset.info, (replace(track, labels={}) for track in list(dataset)[:2]))

    def table(command: str, *options: object) -> str:
        out = tmp_path / "out.csv"
        assert status(command, unlabelled, "--model", tmp_path / "model.yaml", *options, "--out", out) == 0
        return out.read_text()

    for command, options in (("predict", ("--observe", 0.3)), ("estimate", ())):
        a, b, mixture = (table(command, *options, *more) for more in (("--group", "a"), ("--group", "b"), ()))
        assert len({a, b, mixture}) == 3

    write_dataset(tmp_path / "eve", dataset.info, (replace(track, labels={"player": "eve"}) for track in dataset))
    options = ("--observe", 0.3, "--model", tmp_path / "model.yaml", "--out", tmp_path / "eve.csv")
    said, count = printed("predict", tmp_path / "eve", *options).err, len(dataset)
    assert f"{count} of {count} tracks are of groups (player) that the model does not know, such as 'eve'" in said

    def streamed(*options: object) -> str:
        lines = printed("live", *options, "--model", tmp_path / "model.yaml", "--speed", 0).out.splitlines()
        return "".join(str(json.loads(line).get("spin")) for line in lines)

    assert len({streamed("--replay", unlabelled, *more) for more in (("--group", "a"), ("--group", "b"), ())}) == 3
    model_file, out = tmp_path / "model.yaml", tmp_path / "none.csv"
    options = ("predict", unlabelled, "--observe", 0.3, "--out", out)
    assert "group must be one of the model's, a, b; got 'c'" in refused(*options, "--model", model_file, "--group", "c")
    assert "group must be None for a model without groups; got 'a'" in refused(*options, "--group", "a")
    assert not out.exists()


def test_events_in_place_of_positions_are_those_of_python(dataset: Dataset, tmp_path: Path) -> None:
    out = tmp_path / "events.csv"
    asked = ("--plane", "z=0.3,down", "--plane", "x=1.5", "--apex", "--next-contact", "--horizon", "1.5")
    assert status("predict", dataset.path, "--observe", 0.3, *asked, "--out", out) == 0
    table = pa_csv.read_csv(out, convert_options=TEXT)
    assert table["trajectory"].to_pylist() == [track.name for track in dataset for _ in range(4)]
    assert table["event"].to_pylist() == ["z=0.3,down", "x=1.5", "apex", "next-contact"] * len(dataset)
    estimator = estimator_for(dataset, "smoother", None, None, None, 0.3)
    for number, track in enumerate(dataset):
        ahead = estimator.estimate(track.opening(0.3)).predict(1.5, 0.005)
        for place, text in enumerate(table["event"].to_pylist()[:4]):
            row, found = table.slice(4 * number + place, 1).to_pylist()[0], ahead.event(text)
            assert row["probability"] == pytest.approx(found.probability, abs=1e-9)
            for name, value in event_numbers(found.crossing).items():
                shown = np.nan if row[name] is None else row[name]
                assert shown == pytest.approx(value, rel=1e-9, abs=1e-12, nan_ok=True), (text, name)


def test_a_horizon_goes_on_beyond_the_last_stamp(dataset: Dataset, tmp_path: Path) -> None:
    whole, beyond = tmp_path / "whole.csv", tmp_path / "beyond.csv"
    assert status("predict", dataset.path, "--observe", 0.3, "--out", whole) == 0
    assert status("predict", dataset.path, "--observe", 0.3, "--horizon", 5, "--out", beyond) == 0
    before, after = (pa_csv.read_csv(path, convert_options=TEXT).to_pylist() for path in (whole, beyond))
    for track in dataset:
        own, more = ([row for row in rows if row["trajectory"] == track.name] for rows in (before, after))
        assert more[: len(own)] == own
        seen = track.times[track.times <= track.times[0] + 0.3 + 1e-9][-1]
        times = np.array([row["t"] for row in more])
        assert times[-1] == pytest.approx(seen + 5.0, abs=np.median(np.diff(track.times)))
        np.testing.assert_allclose(np.diff(times[len(own) - 1 :]), np.median(np.diff(track.times)), atol=1e-9)


@pytest.mark.parametrize(
    ("more", "rule"),
    [
        (("--plane", "z=3,sideways"), "plane must be an axis and a place in m"),
        (("--plane", "x"), "event must be apex, next-contact or a plane"),
        (("--horizon", "-1"), "horizon must be"),
        (("--apex", "--conformal", "."), "conformal must not be given with events"),
    ],
)
def test_events_that_are_none_are_one_line(dataset: Dataset, tmp_path: Path, more: tuple[str, ...], rule: str) -> None:
    out = tmp_path / "events.csv"
    said = [
        line
        for line in refused("predict", dataset.path, "--observe", 0.3, *more, "--out", out).splitlines()
        if "error" in line
    ]
    assert said[0].startswith(f"ballfg: error: {rule}")
    assert not out.exists()
