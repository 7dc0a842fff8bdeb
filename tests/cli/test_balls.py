"""`ballfg balls` and the option --ball of other commands."""

from __future__ import annotations

from pathlib import Path

import pytest

from ballfg.cli.commands.live import _scene
from ballfg.dynamics import nominal_model
from ballfg.dynamics.coefficient import coefficient_sigmas
from ballfg.dynamics.known_balls import KNOWN_BALLS
from ballfg.simulation import SimulationConfig, write_simulation
from ballfg.simulation.balls import ball_kind
from ballfg.tracks import Ball
from tests.commands import printed, refused, status


def test_the_list() -> None:
    header, *lines = printed("balls").out.splitlines()
    assert header.split()[:5] == ["name", "radius", "mm", "mass", "g"]
    assert [line.split()[0] for line in lines] == list(KNOWN_BALLS)
    (basketball,) = [line.split() for line in lines if line.startswith("basketball")]
    assert basketball[1:6] == ["121.00", "600.0", "0.0248", "19.9", "0.767"]  # sqrt(9.81 / 0.0248) is 19.9 m/s


@pytest.fixture(scope="module")
def basketball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("balls") / "shots"
    write_simulation(folder, SimulationConfig(2, 60.0, seed=2, ball=ball_kind("basketball")))
    return folder


def test_the_ball_of_the_dataset_is_named(basketball: Path, tmp_path: Path) -> None:
    named, plain = tmp_path / "named.csv", tmp_path / "plain.csv"
    for words in (("--ball", "basketball", "--out", named), ("--out", plain)):
        assert "no nominal model" not in printed("estimate", basketball, "--jobs", 1, *words).err
    assert named.read_bytes() == plain.read_bytes()  # the dataset's own ball wins, named or not


@pytest.mark.parametrize("command", ["estimate", "predict", "live"])
def test_another_ball_is_refused(command: str, basketball: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.csv"
    words = {
        "estimate": ["estimate", basketball, "--out", out],
        "predict": ["predict", basketball, "--observe", 0.3, "--out", out],
        "live": ["live", "--replay", basketball, "--out", tmp_path / "out.jsonl"],
    }
    said = refused(*words[command], "--ball", "tennis")
    assert "--ball tennis has a radius of 0.0335 m and 0.0577 kg" in said
    assert "states 0.121 m and 0.6 kg" in said
    assert not out.exists()


@pytest.mark.parametrize("command", ["estimate", "predict", "live"])
def test_a_ball_file_is_the_ball_of_a_dataset(command: str, basketball: Path, tmp_path: Path) -> None:
    """The drag of the file is used; radius and mass alone give the nominal model; another ball is refused."""
    made: dict[str, bytes] = {}
    drag = "flight: {gravity: {}, drag: {k: 0.2}}"
    for name, text in {"same": "radius: 0.121\nmass: 0.6", "own": f"radius: 0.121\nmass: 0.6\n{drag}"}.items():
        (tmp_path / f"{name}.yaml").write_text(text)
    (tmp_path / "other.yaml").write_text("radius: 0.02\nmass: 0.0027")
    for name in ("none", "same", "own", "other"):
        out = tmp_path / f"{name}.{'jsonl' if command == 'live' else 'csv'}"
        words = {
            "estimate": ["estimate", basketball, "--jobs", 1],
            "predict": ["predict", basketball, "--observe", 0.3],
            "live": ["live", "--replay", basketball, "--speed", 0],
        }[command]
        named = [] if name == "none" else ["--ball", tmp_path / f"{name}.yaml"]
        assert status(*words, *named, "--out", out) == (2 if name == "other" else 0)
        lines = out.read_text().splitlines() if out.exists() else []
        made[name] = "".join(line.rpartition(',"latency_ms')[0] or line for line in lines).encode()
    assert made["same"] == made["none"] != made["own"]


def test_a_shuttle(tmp_path: Path) -> None:
    assert "a badminton shuttle is no ball" in refused("simulate", "--ball", "badminton", "--out", tmp_path / "shots")


def test_a_stream_without_a_dataset_is_of_the_ball_that_is_named() -> None:
    ball, _, _ = _scene(None, None, "golf", None, None, None)
    assert (ball.radius, ball.inertia_factor) == (0.021335, 0.4)
    assert _scene(None, None, None, None, None, None)[0].radius == 0.02


def test_a_stream_of_a_ball_file(tmp_path: Path) -> None:
    (tmp_path / "squash.yaml").write_text("radius: 0.0201\nmass: 0.024\nflight: {gravity: {}, drag: {k: 0.016}}")
    ball, _, _ = _scene(None, None, str(tmp_path / "squash.yaml"), None, None, None)
    nominal = nominal_model(Ball(0.0201, 0.024))
    assert ball.radius == 0.0201
    assert float(ball.flight["drag"].k.detach()) == 0.016
    share = 0.5  # of the drag, the prior standard deviation where nothing is known of the ball
    assert coefficient_sigmas(nominal)["flight.drag.k"] == pytest.approx(
        share * float(nominal.flight["drag"].k.detach())
    )
    assert coefficient_sigmas(ball)["flight.drag.k"] == pytest.approx(share * 0.016)
