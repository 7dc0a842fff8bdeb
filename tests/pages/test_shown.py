"""What a page shows of which shots, and results that belong to other data."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv
import pyarrow.parquet as pq
import pytest

from ballfg.pages import shown as room
from ballfg.pages.given import recognise
from ballfg.pages.show_page import _shot
from ballfg.pages.shown import collect
from tests.pages.made import NOISE, Fall, Made, make, write


def test_residuals_are_measured_less_estimated(made: Made) -> None:
    shown = collect(recognise([made.dataset, made.states, made.predictions]))
    assert [shot.name for shot in shown.shots] == list(made.falls)
    for shot, fall in zip(shown.shots, made.falls.values(), strict=True):
        np.testing.assert_allclose(shot.residuals(), shot.positions - fall.states()[:, :3], atol=1e-12)
        assert shot.noise == pytest.approx(NOISE)
        later = fall.times > 0.25
        np.testing.assert_allclose(shot.prediction_errors(), shot.positions[later] - shot.predicted, atol=1e-12)
        (contact,) = shot.marks
        assert contact.time == pytest.approx(fall.contact, abs=5e-4)


def test_predictions_of_flights_are_shown_with_their_recording(made: Made, tmp_path: Path) -> None:
    plain = pa_csv.read_csv(
        made.predictions, convert_options=pa_csv.ConvertOptions(column_types={"trajectory": pa.string()})
    )
    times = plain["t"].to_numpy()
    second = (times > np.median(times)).astype(int).tolist()
    flights = [f"{name}-{k:03d}" for name, k in zip(plain["trajectory"].to_pylist(), second, strict=True)]
    file = tmp_path / "of_flights.csv"
    pa_csv.write_csv(plain.set_column(0, "trajectory", pa.array(flights)), file)
    one, other = (collect(recognise([made.dataset, made.states, path])).shots for path in (made.predictions, file))
    for shot, same in zip(one, other, strict=True):
        assert shot.name == same.name
        np.testing.assert_array_equal(shot.predicted, same.predicted)
        np.testing.assert_array_equal(shot.predicted_times, same.predicted_times)
        cut = int((shot.predicted_times <= np.median(times)).sum())
        begins = np.repeat([shot.times[25], shot.predicted_times[cut - 1]], [cut, len(shot.predicted_times) - cut])
        np.testing.assert_allclose(same.horizons(), same.predicted_times - begins)


def test_noise_of_the_residuals_where_none_is_stated(tmp_path: Path) -> None:
    made = make(tmp_path, {str(i): Fall() for i in range(30)}, noise=False)
    shown = collect(recognise([made.dataset, made.states]))
    assert shown.shots[0].noise == pytest.approx(NOISE, rel=0.1)  # 1800 samples: 3 % of chance
    assert "states no noise" in shown.noise


def test_samples_that_the_estimate_leaves_as_measured_have_no_residual(tmp_path: Path) -> None:
    """60 % of the ball's samples are held: counted, their zeros would leave a noise of none."""
    made = make(tmp_path, {str(i): Fall(samples=100) for i in range(15)}, noise=False)
    head, *states = (line.split(",") for line in made.states.read_text().splitlines())
    _, *measured = (line.split(",") for line in (made.dataset / "tracks.csv").read_text().splitlines())
    for state, seen in zip(states, measured, strict=True):
        if float(state[1]) < 0.595:
            state[2:5] = seen[2:]
    write(made.states, head, states)
    for shot in collect(recognise([made.dataset, made.states])).shots:
        assert np.isnan(shot.residuals()[:60]).all()
        assert np.isfinite(shot.residuals()[60:]).all()
        assert shot.noise == pytest.approx(NOISE, rel=0.15)  # 600 samples: 5 % of chance


@pytest.mark.parametrize(
    ("stated", "sigma"),
    [("position: [0.001, 0.002, 0.004]", (0.001, 0.002, 0.004)), ("acceleration: 0.2", (NOISE, NOISE, NOISE))],
)
def test_noise_that_the_dataset_states_of_each_axis_comes_first(tmp_path: Path, stated: str, sigma: tuple) -> None:
    made = make(tmp_path, {"a": Fall()})
    file = made.dataset / "dataset.yaml"
    file.write_text(file.read_text() + f"noise: {{{stated}}}\n")
    shown = collect(recognise([made.dataset, made.states]))
    np.testing.assert_allclose(shown.shots[0].noise, np.broadcast_to(sigma, (60, 3)))
    x, y, z = (f"{1e3 * s:.2g}" for s in sigma)
    assert f"those of dataset.yaml: {x} mm in x, {y} mm in y, {z} mm in z." in shown.noise


@pytest.mark.parametrize("ending", [".csv", ".parquet"])
def test_labels_of_states_are_shown(made: Made, tmp_path: Path, ending: str) -> None:
    table = pa_csv.read_csv(
        made.states, convert_options=pa_csv.ConvertOptions(column_types={"trajectory": pa.string()})
    )
    labels = ["held" if t < 0.1 else "flight" for t in table["t"].to_pylist()]
    for column, path in ((labels, tmp_path / f"s{ending}"), (["flight"] * len(labels), tmp_path / f"plain{ending}")):
        whole = table.append_column("label", pa.array(column))
        pa_csv.write_csv(whole, path) if ending == ".csv" else pq.write_table(whole, path)
    (shot, *_), (plain, *_) = (
        collect(recognise([made.dataset, tmp_path / f"{n}{ending}"])).shots for n in ("s", "plain")
    )
    assert shot.labels.tolist() == ["held"] * 10 + ["flight"] * 50
    assert [_shot(one)["labels"] for one in (shot, plain)] == [shot.labels.tolist(), []]


def test_results_without_a_dataset(made: Made) -> None:
    shown = collect(recognise([made.predictions]))
    assert (shown.table, shown.coverage, shown.count) == (None, None, 3)
    assert not len(shown.shots[0].times)
    assert len(shown.shots[0].predicted) == 34


def test_shots_are_chosen_and_limited(made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given = recognise([made.dataset])
    assert [shot.name for shot in collect(given, ["b"]).shots] == ["b"]
    with pytest.raises(ValueError, match=r"--track must name one of the 3 shots; got 'bb'. Did you mean 'b'\?"):
        collect(given, ["bb"])
    many = make(tmp_path, {f"{i:03}": Fall(samples=5) for i in range(50)})
    shown = collect(recognise([many.dataset]))
    assert (len(shown.shots), shown.count) == (40, 50)
    assert len(collect(recognise([many.dataset]), limited=False).shots) == 50
    monkeypatch.setattr(room, "MOST_ROWS", 12)
    assert len(collect(recognise([many.dataset])).shots) == 2
    with pytest.raises(ValueError, match=r"a page holds 12 samples.*--rerun"):
        collect(given, ["a"])


def test_results_of_other_data_are_refused(made: Made, tmp_path: Path) -> None:
    other = make(tmp_path / "named", {"z": Fall()})
    with pytest.raises(ValueError, match="has a trajectory 'z', which the dataset does not have"):
        collect(recognise([made.dataset, other.predictions]))
    longer = make(tmp_path / "longer", {"a": Fall(samples=80)})
    with pytest.raises(ValueError, match=r"t = 0.6 s of trajectory 'a', where the dataset has no sample"):
        collect(recognise([made.dataset, longer.states]))


def test_notes_on_results_of_some_shots_and_another_diagnosis(made: Made, report: Path, tmp_path: Path) -> None:
    part = make(tmp_path, {"a": Fall()})
    shown = collect(recognise([made.dataset, part.states, report]))
    assert any("states.csv has rows for 1 of the 3 shots" in note for note in shown.notes)
    assert any("The diagnosis is of 'shots <in a draught>'" in note for note in shown.notes)
