"""A planted rally from candidates to files and page: strokes, events, what is written, what the page shows."""

from __future__ import annotations

import csv
import json
import re
import shutil
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import unquote

import numpy as np
import pytest

from ballfg.benchmarks.cameras.films import Truth
from ballfg.benchmarks.cameras.hall import COURT
from ballfg.benchmarks.cameras.strokes import MODEL
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation import Smoother, dataset_settings, dataset_surfaces, read_sighted
from ballfg.estimation.rally.events import end_of, events_in_play, net_touches, stroke_row
from ballfg.estimation.rally.hits import HIT_SIGMA
from ballfg.estimation.rally.moments import carried
from ballfg.estimation.rally.page import between, rally_page
from ballfg.estimation.rally.reconstruct import reconstruct
from ballfg.estimation.rally.tables import write_rally
from ballfg.estimation.rally.video import Rally
from ballfg.estimation.result import Estimate
from ballfg.state import POSITION
from ballfg.tracks import TABLE_TENNIS
from ballfg.tracks.info import DatasetInfo
from ballfg.vision.broadcast.files import is_rally
from tests.browser import needs_browser, opened
from tests.commands import status
from tests.estimation.rally.planted import SURFACES, planted
from tests.vision.broadcast.tennis import TENNIS

NET = 0.1525


def found_in(view: str, seed: int, missing: float = 0.0, travel: float = 0.0) -> tuple[Truth, Rally]:
    of, motion, found = planted(view, seed, missing=missing, travel=travel)
    one = reconstruct(found, motion.shots[0], MODEL, SURFACES)
    events = events_in_play(one, MODEL, SURFACES, 0.04, NET)
    rows = [stroke_row(estimate, events, MODEL, NET) for estimate in one.estimates]
    return of, Rally(motion, (one,), tuple(events), tuple(rows))


@pytest.fixture(scope="module", params=[0.0, 0.8], ids=["stands", "moves"])
def made(request: pytest.FixtureRequest) -> tuple[Truth, Rally]:
    """Of a camera that stands, and of one that moves by 0.8 m along the table."""
    return found_in("side", 21, travel=request.param)


@pytest.fixture(scope="module")
def folder(made: tuple[Truth, Rally], tmp_path_factory: pytest.TempPathFactory) -> Path:
    rally, out = made[1], tmp_path_factory.mktemp("rally") / "rally"
    info = DatasetInfo("rally", 0.0, TABLE_TENNIS, rate=25.0, source="ballfg track r.mp4", table_extent=SURFACES.extent)
    write_rally(out, info, rally.motion, rally.shots, rally.events, rally.strokes)
    return out


def test_each_planted_stroke_is_found_with_its_events(made: tuple[Truth, Rally]) -> None:
    of, rally = made
    true = [one for one in of.strokes if one.end < 2.6 - 0.04]
    (shot,) = rally.shots
    for one in true:
        states = {float(t): of.at(float(t)) for estimate in shot.estimates for t in estimate.times}
        (mine,) = (e for e in shot.estimates if one.begin < float(np.median(e.times)) <= one.end)
        off = [
            np.linalg.norm(states[float(t)][POSITION] - state[POSITION])
            for t, state in zip(mine.times, mine.states, strict=True)
            if states[float(t)] is not None
        ]
        sigma = float(np.sqrt(np.trace(mine.covariances[:, POSITION, POSITION], axis1=1, axis2=2).max()))
        assert np.median(off) < min(3.0 * sigma, 0.2)
        hit = next(event for event in rally.events if event.kind == "hit" and event.trajectory == mine.name)
        assert hit.t == pytest.approx(one.begin, abs=max(0.06, 3.0 * hit.sigma_t))
        row = next(row for row in rally.strokes if row["stroke"] == mine.name)
        assert row["end"] == ("-x" if one.state[3] > 0.0 else "+x")
        assert abs(float(row["speed_hit"]) - np.linalg.norm(one.state[3:6])) < max(
            1.0, 3.0 * float(row["sigma_speed_hit"])
        )
        assert float(row["net_clearance"]) > 0.0
    bounces = [event for event in rally.events if event.kind == "bounce"]
    assert all(abs(event.place[2] - MODEL.radius) < 0.01 for event in bounces)
    assert [event.t for event in rally.events] == sorted(event.t for event in rally.events)


@pytest.mark.thorough
@pytest.mark.parametrize("seed", [31, 32, 33])
def test_strokes_are_found_from_behind_with_a_fifth_of_the_sightings_missing(seed: int) -> None:
    of, rally = found_in("near", seed, missing=0.2)
    true = [one for one in of.strokes if one.end < 2.6]
    middles = [float(np.median(estimate.times)) for shot in rally.shots for estimate in shot.estimates]
    found = sum(any(one.begin < middle <= one.end for middle in middles) for one in true)
    assert found >= len(true) - 1


def test_nothing_is_found_among_clutter_alone() -> None:
    _, motion, found = planted("side", 21, missing=1.0, false=12)
    one = reconstruct(found, motion.shots[0], MODEL, SURFACES)
    assert not [stroke for stroke, p in zip(one.chosen.strokes, one.chosen.probabilities, strict=True) if p > 0.5]


def test_what_is_written_is_a_dataset_that_other_commands_read(made: tuple[Truth, Rally], folder: Path) -> None:
    rally = made[1]
    assert is_rally(folder)
    assert len(read_sighted(folder)) == len(rally.strokes)
    (shot,) = rally.motion.shots
    lines = (folder / "camera_motion.csv").read_text(encoding="utf-8").splitlines()
    assert len(lines) == 1 + len(shot)
    header = (folder / "states.csv").read_text(encoding="utf-8").partition("\n")[0].split(",")
    assert {"rho_xy", "rho_xz", "rho_yz"} <= set(header)
    kinds = {line.split(",")[2] for line in (folder / "events.csv").read_text(encoding="utf-8").splitlines()[1:]}
    assert kinds <= {"hit", "bounce", "lost", "net", "floor", "cut"}
    with (folder / "strokes.csv").open(encoding="utf-8", newline="") as file:
        assert [row["end"] for row in csv.DictReader(file)] == [row["end"] for row in rally.strokes]


def alone(folder: Path) -> list[Estimate]:
    """The estimates of the strokes one by one, from the written files."""
    data = read_sighted(folder)
    smoother = Smoother(MODEL, dataset_surfaces(data), dataset_settings(data, MODEL))
    return [smoother.estimate(track) for track in data]


def test_estimates_from_the_written_dataset_agree_with_those_of_track(made: tuple[Truth, Rally], folder: Path) -> None:
    for one, joined in zip(alone(folder), made[1].shots[0].estimates, strict=True):
        assert one.name == joined.name
        assert len(one.contacts) == len(joined.contacts)
        off = np.abs(one.states[:, POSITION] - joined.states[:, POSITION])
        assert (off < 2.0 * one.sigmas[:, POSITION]).all()


def test_strokes_that_are_joined_meet_at_the_hit_and_are_nearer_to_the_truth_there(
    made: tuple[Truth, Rally], folder: Path
) -> None:
    of, (shot,) = made[0], made[1].shots
    gaps, errors = [], []
    for estimates in (alone(folder), shot.estimates):
        pairs = [(a, b, hit.t) for a, b, hit in zip(estimates, estimates[1:], shot.hits[1:], strict=False) if hit]
        ends = [
            (carried(MODEL, a, -1, t).state[POSITION], carried(MODEL, b, 0, t).state[POSITION]) for a, b, t in pairs
        ]
        gaps.append(np.median([np.linalg.norm(a - b) for a, b in ends]))
        near = [(one.states[k, POSITION], of.at(float(one.times[k]))) for one in estimates for k in (0, -1)]
        errors.append(np.median([np.linalg.norm(place - true[POSITION]) for place, true in near if true is not None]))
    assert len(pairs) >= 2
    assert gaps[1] < min(0.7 * gaps[0], 2.0 * HIT_SIGMA)
    assert errors[1] < errors[0]


def test_bounces_without_a_column_are_refused_in_one_line(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder, tmp_path / "other")
    events = tmp_path / "other" / "events.csv"
    events.write_text(events.read_text(encoding="utf-8").replace("kind", "sort", 1), encoding="utf-8")
    with pytest.raises(ValueError, match=r"events.csv must have the columns trajectory, t, kind; kind is missing"):
        read_sighted(tmp_path / "other")


def falling(state: list[float], times: list[float]) -> Estimate:
    """A ball in free fall, sure to 1 cm, from a first state (6,)."""
    t = np.array(times)
    place = np.array(state[:3]) + np.outer(t, state[3:]) - 0.5 * 9.81 * np.outer(t**2, [0.0, 0.0, 1.0])
    velocity = np.array(state[3:]) - 9.81 * np.outer(t, [0.0, 0.0, 1.0])
    states = np.column_stack((place, velocity, np.zeros((len(t), 3))))
    return SimpleNamespace(name="000", times=t, states=states, covariances=np.tile(1e-4 * np.eye(9), (len(t), 1, 1)))  # type: ignore[return-value]


@pytest.mark.parametrize(
    ("state", "last", "kinds"),
    [
        ([-0.5, 0.0, 0.10, 8.0, 0.0, 0.3], 0.12, ["net"]),  # through the net's height
        ([-0.5, 0.0, 0.40, 8.0, 0.0, 0.3], 0.12, []),  # over it
        ([-0.5, 1.5, 0.10, 8.0, 0.0, 0.3], 0.12, []),  # beside its posts
        ([-0.5, 0.0, 0.10, 8.0, 0.0, 0.3], 0.04, ["net"]),  # last seen two pictures before it
        ([-0.9, 0.0, 0.10, 8.0, 0.0, 0.3], 0.02, []),  # last seen far before it
    ],
)
def test_a_net_is_touched_where_the_path_meets_it(state: list[float], last: float, kinds: list[str]) -> None:
    estimate = falling(state, np.linspace(0.0, last, 4).tolist())
    touches = net_touches(MODEL, estimate, SURFACES, NET, 0.08)
    assert [touch.kind for touch in touches] == kinds
    for touch in touches:
        assert touch.t == pytest.approx(0.5 / 8.0, abs=0.003)
        assert touch.place[0] == pytest.approx(0.0, abs=0.02)
        assert 0.9 < touch.probability <= 1.0


def test_a_ball_that_falls_to_the_floor_ends_there_and_one_in_the_air_is_lost() -> None:
    low = falling([2.5, 0.3, -0.55, 3.0, 0.0, -2.0], [0.0, 0.02, 0.04])
    end = end_of(MODEL, low, SURFACES, 0.04)
    height = 0.55 - 0.76 + MODEL.radius  # of the start under the place where it lands, negative
    true = (-2.0 + np.sqrt(4.0 - 2.0 * 9.81 * height)) / 9.81
    assert (end.kind, end.t) == ("floor", pytest.approx(true, abs=0.004))
    assert end.place[2] == pytest.approx(-0.76 + MODEL.radius, abs=0.02)
    high = falling([2.5, 0.3, 0.5, 3.0, 0.0, -2.0], [0.0, 0.02, 0.04])
    lost = end_of(MODEL, high, SURFACES, 0.04)
    assert (lost.kind, lost.t) == ("lost", pytest.approx(0.04))


def test_a_path_between_knots_meets_them_and_falls_freely() -> None:
    start, velocity, fall = np.array([0.0, 1.0, 0.3]), np.array([4.0, -1.0, 2.0]), np.array([0.0, 0.0, -9.81])

    def at(t: float) -> tuple[float, np.ndarray, np.ndarray]:
        return t, start + velocity * t + 0.5 * fall * t**2, velocity + fall * t

    a, b = at(0.0), at(0.2)
    for pair in ((a, b), (a, (b[0], b[1], None)), ((a[0], a[1], None), b)):
        points = np.array(between(*pair))
        true = np.array([at(t)[1] for t in points[:, 0]])
        np.testing.assert_allclose(points[:, 1:], true, atol=1e-9)
    straight = np.array(between((0.0, start, None), (0.1, start + 1.0, None)))
    np.testing.assert_allclose(straight[:, 1], 10.0 * straight[:, 0], atol=1e-9)


def data_of(page: str) -> dict[str, object]:
    (text,) = re.findall(r'id="data">(.*?)</script>', page, flags=re.DOTALL)
    found: dict[str, object] = json.loads(text)
    return found


def test_the_page_holds_the_rally_and_says_that_the_video_is_missing(
    made: tuple[Truth, Rally], folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "page.html"
    assert status("show", folder, "--out", out) == 0
    said = capsys.readouterr()
    assert "r.mp4 was not found" in said.err
    data = data_of(out.read_text(encoding="utf-8"))
    rally = made[1]
    assert [len(data[key]) for key in ("frames", "candidates")] == [len(rally.motion.times)] * 2  # type: ignore[arg-type]
    strokes: list[dict[str, list[list[float]]]] = data["strokes"]  # type: ignore[assignment]
    assert len(strokes) == len(rally.strokes)
    # candidates lie where the detector saw them, although detections.csv holds them for the fixed camera
    first = rally.shots[0].chosen.strokes[0]
    frame = int(rally.shots[0].seen.frame[first.rows[0]])
    ball = rally.shots[0].seen.pixels[first.rows[0]]
    spots: list[list[list[float]]] = data["candidates"]  # type: ignore[assignment]
    flown = [spot for spot in spots[frame] if spot[3]]
    assert len(flown) == 1
    assert np.hypot(flown[0][0] - ball[0], flown[0][1] - ball[1]) < 0.5
    # a drawn path goes through the estimated places
    for stroke, estimate in zip(strokes, rally.shots[0].estimates, strict=True):
        path = np.array(stroke["path"])
        for t, state in zip(estimate.times, estimate.states, strict=True):
            place = [np.interp(t, path[:, 0], path[:, 1 + axis]) for axis in range(3)]
            assert np.linalg.norm(place - state[POSITION]) < 0.02


def test_the_page_draws_the_court_that_a_user_gave(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder, tmp_path / "other")
    assert data_of(rally_page(folder, None, tmp_path / "page.html")[0])["table"]["net"] == [NET, 0.7625 + NET]  # type: ignore[index]
    (tmp_path / "other" / "court.yaml").write_text(TENNIS, encoding="utf-8")
    table: dict[str, list[object]] = data_of(rally_page(tmp_path / "other", None, tmp_path / "page.html")[0])["table"]  # type: ignore[assignment]
    assert (table["net"], table["extent"], table["floor"]) == ([0.914, 6.4], [-11.885, 11.885, -5.485, 5.485], None)
    assert len(table["lines"]) == 10


def test_a_video_that_is_not_there_is_named(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert status("show", folder, tmp_path / "no.mp4", "--out", tmp_path / "page.html") == 2
    assert "no.mp4 does not exist" in capsys.readouterr().err
    assert not (tmp_path / "page.html").exists()


def test_what_a_page_of_a_rally_leaves_out_is_refused(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--png", tmp_path / "shot.png", "--track", "000"]
    assert status("show", folder, "--out", tmp_path / "page.html", *words) == 2
    assert "got --png, --track. Leave it out." in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_small_video_is_inside_and_a_large_one_is_linked(folder: Path, tmp_path: Path) -> None:
    small, large = tmp_path / "a.mp4", tmp_path / "b.mp4"
    small.write_bytes(b"video")
    with large.open("wb") as file:
        file.truncate(9 * 2**20)
    assert "data:video/mp4;base64,dmlkZW8=" in rally_page(folder, small, tmp_path / "page.html")[0]
    page, notes = rally_page(folder, large, tmp_path / "sub" / "page.html")
    assert 'src="../b.mp4"' in page
    assert "8 MB" in notes[0]


def test_the_video_of_a_rally_is_found_by_its_whole_name_and_linked_by_an_address(folder: Path, tmp_path: Path) -> None:
    """Of `my r.mp4`, not of `r.mp4` beside it; signs of addresses in a name stay signs of the name."""
    other, source = tmp_path / "other", "ballfg track my r.mp4"
    shutil.copytree(folder, other)
    (other / "dataset.yaml").write_text((other / "dataset.yaml").read_text().replace("ballfg track r.mp4", source))
    (tmp_path / "r.mp4").write_bytes(b"another")
    _, notes = rally_page(other, None, tmp_path / "page.html")
    assert "my r.mp4 was not found" in notes[0]
    (tmp_path / "my r.mp4").write_bytes(b"video")
    assert "base64,dmlkZW8=" in rally_page(other, None, tmp_path / "page.html")[0]
    large = tmp_path / 'a#1 50%&"<b>.mp4'
    with large.open("wb") as file:
        file.truncate(9 * 2**20)
    page, _ = rally_page(other, large, tmp_path / "page.html")
    (address,) = re.findall(r'src="([^"]*)"', page)
    assert not set(address) & set("#&<?")
    assert unquote(address) == large.name


PLAY = """
const frame = document.querySelector("iframe");
frame.addEventListener("load", () => setTimeout(() => {
  const inside = frame.contentDocument, rows = inside.querySelectorAll("#strokes tbody tr");
  const drawn = id => { const c = inside.getElementById(id);
                        const d = c.getContext("2d").getImageData(0, 0, c.width, c.height).data;
                        return d.reduce((count, value, i) => count + (i % 4 === 3 && value > 0), 0); };
  const found = {rows: rows.length, bounces: inside.querySelectorAll("#above ellipse").length,
                 bars: inside.querySelectorAll("#line rect").length,
                 wide: inside.documentElement.scrollWidth - inside.documentElement.clientWidth};
  found.cells = Array.from(rows).map(row => Array.from(row.cells).map(cell => cell.textContent));
  rows[1].click();
  found.clicked = inside.getElementById("readout").textContent;
  found.overlay = drawn("overlay"); found.space = drawn("space");
  inside.getElementById("spots").click();
  found.spots = drawn("overlay");
  inside.getElementById("on").click();
  found.next = inside.getElementById("readout").textContent;
  found.trouble = inside.getElementById("trouble").textContent;
  document.body.dataset.found = JSON.stringify(found);
}, 1500));
"""


@needs_browser
@pytest.mark.parametrize("width", [400, 1300])
def test_a_browser_draws_the_rally_and_a_click_goes_to_its_stroke(
    made: tuple[Truth, Rally], folder: Path, tmp_path: Path, width: int
) -> None:
    page, _ = rally_page(folder, None, tmp_path / "page.html")
    elements, console = opened(page, width, PLAY, tmp_path)
    assert not [line for line in console if re.search("error|uncaught|exception", line, flags=re.IGNORECASE)]
    (text,) = re.findall(r'<body data-found="([^"]*)"', elements)
    found = json.loads(text.replace("&quot;", '"'))
    rally = made[1]
    assert found["rows"] == found["bars"] == len(rally.strokes)
    assert found["bounces"] == sum(event.kind == "bounce" for event in rally.events)
    assert found["wide"] <= 0
    unsure = [float(cell.split(" ± ")[1]) for row in found["cells"] for cell in row if " ± " in cell]
    assert len(unsure) > 4 * len(rally.strokes)
    assert min(unsure) > 0.0, "a bounce's place is shown as exact"
    hit = next(e for e in rally.events if e.kind == "hit" and e.trajectory == rally.strokes[1]["stroke"])
    assert found["clicked"].startswith(f"t = {hit.t:.3f} s")
    assert f"stroke {rally.strokes[1]['stroke']}" in found["clicked"]
    assert found["next"] != found["clicked"]
    assert found["overlay"] > 200
    assert found["space"] > 2000
    assert found["spots"] != found["overlay"]
    assert "cannot be played" in found["trouble"]


def test_the_court_and_the_surfaces_agree() -> None:
    assert isinstance(SURFACES, Surfaces)
    assert SURFACES.extent == pytest.approx((-1.37, 1.37, -0.7625, 0.7625))
    assert SURFACES.floor_height == COURT.floor
