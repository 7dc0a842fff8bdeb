"""The C header of a model, compiled, against ballfg's own flights, contacts, Jacobians and predictions."""

from __future__ import annotations

import ctypes
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from ballfg.arrays import Array
from ballfg.dynamics import AnalyticModel, Surfaces, nominal_model
from ballfg.dynamics.compiled.beliefs.course import density_of
from ballfg.dynamics.compiled.contacts import contacts
from ballfg.dynamics.compiled.functions import compiled
from ballfg.dynamics.compiled.in_c.routines import Routine, Translator
from ballfg.dynamics.compiled.in_c.values import UntranslatableError
from ballfg.dynamics.compiled.motion import Moving, world_of
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.motion.by_machine_code import fly_jacobian
from ballfg.factors.noise import ProcessNoise
from ballfg.prediction import BallState, Belief, Propagator, plane_crossing
from ballfg.prediction.c_header import c_header
from ballfg.prediction.state import World
from tests.commands import status
from tests.dynamics.compiled.test_networks import network, small
from tests.places import DOCS

CC = shutil.which("cc")
pytestmark = pytest.mark.skipif(CC is None, reason="no C compiler on this machine")
STRICT = ("-Wall", "-Wextra", "-pedantic", "-Werror")
WRAPPED = """
#include "ball.h"
int predict(const double *w, const double *n, const double *x, const double *p, int k, const double *t,
  double *xs, double *ps) { return ball_predict(w, n, x, p, k, t, xs, ps); }
int cross(const double *w, const double *n, const double *x, const double *p, const double *normal, double offset,
  int direction, double horizon, double *t, double *s, double *at, double *spread) {
  return ball_cross_plane(w, n, x, p, normal, offset, direction, horizon, t, s, at, spread); }
int flights(int n, const double *x, const double *dt, double *y, double *j) {
  int done = 0;
  for (int i = 0; i < n; ++i) done += ball_fly(x + 9 * i, dt[i], y + 9 * i, j + 81 * i);
  return done; }
int contacts(int n, const double *x, double height, double longest, double *t, double *y, double *j) {
  int done = 0;
  for (int i = 0; i < n; ++i) done += ball_contact(x + 9 * i, height, longest, t + i, y + 9 * i, j + 81 * i);
  return done; }
"""
SURFACES = Surfaces(0.0, -0.76, (-1.4, 1.4, -0.8, 0.8), (0.01, 0.01, 0.01, 0.01))
NOISE = ProcessNoise()
TIMES = 0.02 * np.arange(1, 31)


class InC:
    """A model as compiled C; arrays are passed by their addresses."""

    def __init__(self, model: BallModel, folder: Path) -> None:
        self.model, self.text = model, c_header(model, "ball")
        (folder / "ball.h").write_text(self.text)
        (folder / "ball.c").write_text(WRAPPED)
        words = [str(CC), "-std=c99", "-O1", *STRICT, "-shared", "-fPIC", "-o", "ball.so", "ball.c", "-lm"]
        subprocess.run(words, cwd=folder, check=True)
        self.library = ctypes.CDLL(str(folder / "ball.so"))

    def __call__(self, name: str, *given: Any) -> int:
        kinds: dict[type, Callable[[Any], Any]] = {
            float: ctypes.c_double, int: ctypes.c_int, np.ndarray: lambda array: array.ctypes.data_as(ctypes.c_void_p)
        }  # fmt: skip
        result: int = getattr(self.library, name)(*(kinds[type(value)](value) for value in given))
        return result

    def predict(self, state: Array, covariance: Array, times: Array) -> tuple[int, Array, Array]:
        states, covariances = np.empty((len(times), 9)), np.empty((len(times), 9, 9))
        done = self("predict", *surroundings(self.model), state, covariance, len(times), times, states, covariances)
        return done, states[:done], covariances[:done]

    def cross(self, state: Array, covariance: Array, normal: Array, offset: float, way: int) -> tuple[int, list[Array]]:
        found = [np.empty(1), np.empty(1), np.empty(9), np.empty((9, 9))]
        given = (*surroundings(self.model), state, covariance, normal, offset, way, 1.0, *found)
        return self("cross", *given), found


def surroundings(model: BallModel) -> tuple[Array, Array]:
    return world_of(SURFACES, model.radius), density_of(NOISE)


def correction() -> BallModel:
    return small("mnn+gs")


def trained() -> BallModel:
    return network("mnn+gs")


@pytest.fixture(scope="module", params=[nominal_model, correction, pytest.param(trained, marks=pytest.mark.thorough)])
def in_c(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> InC:
    return InC(request.param(), tmp_path_factory.mktemp("c"))


def states(n: int) -> Array:
    found = np.random.default_rng(1).normal(size=(n, 9)) * np.repeat((1.0, 5.0, 100.0), 3)
    found[:, 2] = np.abs(found[:, 2])
    return found


def shots(n: int) -> list[tuple[Array, Array]]:
    """States that come down on the table, beside it, or on its edge, with covariances."""
    rng = np.random.default_rng(2)
    low, high = np.array([-1.2, -0.9, 0.05, 3.0, -1, -2, -60, -60, -60]), np.array([0, 0.9, 0.5, 5, 1, 2, 60, 60, 60])
    roots = 0.3 * rng.normal(size=(n, 9, 9)) + np.eye(9)
    roots *= np.repeat((0.004, 0.04, 8.0), 3)[:, None]
    return list(zip(rng.uniform(low, high, (n, 9)), roots @ roots.swapaxes(1, 2), strict=True))


def close(own: Array, right: Array) -> None:
    np.testing.assert_allclose(own, right, rtol=1e-12, atol=1e-12)


def test_flight(in_c: InC) -> None:
    n, x = 10_000, states(10_000)
    dt, after, jacobians = np.random.default_rng(3).uniform(-0.02, 0.02, n), np.empty((n, 9)), np.empty((n, 9, 9))
    assert in_c("flights", n, x, dt, after, jacobians) == n
    functions = compiled(in_c.model)
    assert functions is not None
    right = fly_jacobian(in_c.model, functions, torch.from_numpy(x), torch.from_numpy(dt))
    close(after, right[0].numpy())
    close(jacobians, right[1].numpy())


def test_contacts(in_c: InC) -> None:
    n = 10_000 if isinstance(in_c.model, AnalyticModel) else 1000
    x, functions = states(n), compiled(in_c.model)
    times, after, jacobians = np.empty(n), np.empty((n, 9)), np.empty((n, 9, 9))
    found = in_c("contacts", n, x, 0.1, 0.5, times, after, jacobians)
    assert 0 < found < n
    assert functions is not None
    for i in range(n):  # one by one: those of a batch share their number of integration steps
        ball = Moving(in_c.model, functions, x[i : i + 1], 9)
        given = (*ball.addresses, x[i : i + 1], np.eye(9)[None], *ball.all_coefficients(), *ball.weights)
        tau, bounced, by_state = np.empty(1), np.empty((1, 9)), np.empty((1, 9, 9))
        level, longest = np.full(1, 0.1), np.full(1, 0.5)
        contacts(*given, level, longest, functions.radius, tau, np.empty((1, 9)), bounced, by_state)
        close(times[i], tau[0])
        close(after[i], bounced[0])
        if np.isfinite(times[i]):
            close(jacobians[i], by_state[0])


def on_table(model: BallModel) -> torch.Tensor:
    """(1, 9) a ball that rolls."""
    state = torch.tensor([[0, 0, model.radius, 0.5, 0.1, 0, 0, 20, 0]], dtype=torch.float64)
    state[0, 2] += float(torch.as_tensor(model.surface_offset(state[0])).detach())
    return state


def test_predictions(in_c: InC) -> None:
    propagator, whole = Propagator(SURFACES, NOISE), 0
    for state, covariance in shots(60):
        done, means, spreads = in_c.predict(state, covariance, TIMES)
        belief = Belief(in_c.model, np.zeros(1), state[None], covariance[None])
        right = propagator.rollout(belief, TIMES)
        close(means, right.states[0, :done])
        close(spreads, right.covariances[0, :done])
        whole += done == len(TIMES)
    assert whole > 40  # others bounce at an edge of the table
    belief = Belief(in_c.model, np.zeros(1), on_table(in_c.model).numpy(), covariance[None])
    right = propagator.rollout(belief, TIMES)
    done, means, spreads = in_c.predict(belief.mean[0], covariance, TIMES)
    assert done == len(TIMES)
    close(means, right.states[0])
    close(spreads, right.covariances[0])


@pytest.mark.parametrize(("way", "direction"), [(1, "up"), (-1, "down"), (0, "either")])
def test_crossings(in_c: InC, way: int, direction: str) -> None:
    propagator, ends = Propagator(SURFACES, NOISE), []
    for k, (state, covariance) in enumerate(shots(40)):
        normal, offset = np.array([2.0, 0.0, 0.0] if k % 2 else [0.3, 0.0, -1.0]), 1.5 if k % 2 else -0.2
        end, (time, sigma, there, spread) = in_c.cross(state, covariance, normal, offset, way)
        belief = Belief(in_c.model, np.zeros(1), state[None], covariance[None])
        right = plane_crossing(propagator, belief, normal, offset, 1.0, direction=direction)
        ends.append(end)
        if end == 0:
            assert right is None
        if end == 1:
            assert right is not None
            close(np.array([time[0], sigma[0]]), np.array([right.time, right.time_sigma]))
            close(there, right.state)
            close(spread, right.covariance)
    assert {0, 1} <= set(ends)


def test_the_header_says_that_a_crossing_near_a_contact_counts_one_side_of_it(tmp_path: Path) -> None:
    """Just after a bounce that some balls have not reached; `predict` and the `crossing` of a forecast count both."""
    ball, state = InC(nominal_model(), tmp_path), np.array([-1.0, 0.1, 0.3, 4.0, 0.2, 1.0, 0.0, 60.0, 0.0])
    covariance = np.diag(np.repeat((0.002, 0.03, 8.0), 3) ** 2)
    end, (time, _, _, spread) = ball.cross(state, covariance, np.array([1.0, 0.0, 0.0]), 0.3, 1)
    both = ball.predict(state, covariance, time)[2][0]
    world = World(ball.model, SURFACES, NOISE)
    crossing = BallState(0.0, state, covariance, world=world).predict(1.0).crossing(x=0.3)
    assert end == 1
    assert crossing is not None
    for other in (both, crossing.covariance):
        assert other[5, 5] > 25.0 * spread[5, 5]
    assert "All balls are taken to cross on the mean's side of a contact" in ball.text


def test_what_cannot_be_answered_is_said(in_c: InC) -> None:
    (state, covariance), *_ = shots(1)
    assert in_c.predict(state, covariance, np.array([0.1, 0.05]))[0] == 1  # not sorted
    assert in_c.predict(state, covariance, np.array([np.nan]))[0] == 0
    assert in_c.cross(state, covariance, np.zeros(3), 1.0, 0)[0] == -1
    assert in_c.cross(state, covariance, np.array([1.0, 0.0, 0.0]), np.nan, 0)[0] == -1
    rest = on_table(in_c.model)[0].numpy()
    rest[5] = -0.04
    assert in_c.predict(rest, covariance, TIMES)[0] == 0  # it lands
    outs = np.empty((1, 9)), np.empty((1, 9, 9))
    assert in_c("flights", 1, state[None].copy(), np.array([np.inf]), *outs) == 0
    assert in_c("contacts", 1, state[None].copy(), 0.0, float("nan"), np.empty(1), *outs) == 0


@pytest.mark.parametrize("motion", [(np.nan, 0, 0), (np.inf, 0, 0), (4, 1, np.nan)], ids=["nan", "inf", "spin"])
def test_results_that_are_no_numbers_are_no_success(in_c: InC, motion: tuple[float, float, float]) -> None:
    (_, covariance), *_ = shots(1)
    state = np.array([[-1.0, 0.1, 0.3, motion[0], motion[1], 1.0, 0.0, motion[2], 0.0]])
    outs = np.empty((1, 9)), np.empty((1, 9, 9))
    assert in_c("flights", 1, state, np.array([0.1]), *outs) == 0
    assert in_c("contacts", 1, state, 0.0, 5.0, np.empty(1), *outs) == 0
    assert in_c.predict(state[0], covariance, TIMES)[0] == 0
    assert in_c.cross(state[0], covariance, np.array([1.0, 0.0, 0.0]), 1.0, 0)[0] == -1


def test_a_flight_that_no_ball_had_is_no_success(tmp_path: Path) -> None:
    """Backwards drag speeds a ball up: before the last 20 s there is none with 4 m/s; 0.1 s are usual."""
    ball = InC(nominal_model(), tmp_path)
    state, outs = np.array([[-1.0, 0.1, 0.3, 4.0, 0.2, 1.0, 0.0, 60.0, 0.0]]), (np.empty((1, 9)), np.empty((1, 9, 9)))
    assert [ball("flights", 1, state, np.array([dt]), *outs) for dt in (-20.0, -0.1, 20.0)] == [0, 1, 1]
    assert np.isfinite(outs[0]).all()
    (_, covariance), *_ = shots(1)
    for speed in (1e4, 1e160):
        state[0, 3] = speed
        assert ball("flights", 1, state, np.array([20.0]), *outs) == 0
        done, means, spreads = ball.predict(state[0], covariance, TIMES)
        assert done < len(TIMES)
        assert np.isfinite(means).all()
        assert np.isfinite(spreads).all()


def test_header(in_c: InC, tmp_path: Path) -> None:
    """The same bytes again, less than 200 kB, and C++ as well."""
    assert in_c.text == c_header(in_c.model, "ball")
    assert len(in_c.text) < 200_000
    assert set(re.findall(r"#include (.*)", in_c.text)) == {"<math.h>", "<stdint.h>"}
    (tmp_path / "ball.cpp").write_text(in_c.text)
    if cpp := shutil.which("c++"):
        subprocess.run([cpp, *STRICT, "-fsyntax-only", "ball.cpp"], cwd=tmp_path, check=True)


@pytest.mark.parametrize("option", ["-ffast-math", "-ffinite-math-only"])
def test_options_that_drop_nan_are_refused(option: str, tmp_path: Path) -> None:
    """With them states that are not numbers were counted as written."""
    (tmp_path / "ball.h").write_text(c_header(nominal_model(), "ball"))
    words = [str(CC), "-std=c99", "-O3", option, "-fsyntax-only", "ball.h"]
    said = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True)
    assert said.returncode != 0
    assert f"compile it without {option}" in said.stderr or f"-Ofast, {option}" in said.stderr


def test_the_guide(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    shell, program, compiling = re.findall(r"```\w*\n(.*?)```", (DOCS / "export.md").read_text("utf-8"), re.DOTALL)
    assert status(*shell.split()[1:]) == 0
    Path("robot.c").write_text(program)
    subprocess.run(compiling.split(), check=True)
    said = subprocess.run(["./robot"], check=True, capture_output=True, text=True).stdout
    assert re.fullmatch(r"in 0\.7\d\d s, at y = 0\.2\d\d m, z = 0\.\d+ m \+- \d+ mm\n30 of 30 states\n", said)


VARIED = """\
flight: {gravity: {}, drag: {k: 0.125}}
bounce: {restitution: {e: 0.92}}
variations:
  flight.drag.k: {by: player, values: {ann: 0.25, bob: 0.0625}}
populations:
  spin: {by: player, groups: {ann: {mean: [0, 9, 0], sigma: [9, 9, 9], tracks: 4},
    bob: {mean: [0, 9, 0], sigma: [9, 9, 9], tracks: 4}}}
"""


def test_a_group_has_its_coefficients_and_without_one_the_header_says_what_it_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("model.yaml").write_text(VARIED)
    for group, drag in (("ann", ".25"), ("bob", ".0625"), (None, ".125")):
        assert status("export", "model.yaml", "--out", "ball.h", *(("--group", group) if group else ())) == 0
        assert f"ball_rates_coefficients[2] = {{9.81,{drag}}};" in Path("ball.h").read_text()
        note = "flight.drag.k differs by player; the header has 0.125, that of other tracks. Give --group NAME"
        assert (note in capsys.readouterr().err) == (group is None)
    assert status("export", "model.yaml", "--out", "other.h", "--group", "eve") == 2
    assert "group must be one of the model's, ann, bob; got 'eve'" in capsys.readouterr().err
    assert not Path("other.h").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("nowhere.yaml --out ball.h", "does not exist"),
        ("tabletenis --out ball.h", "did you mean"),
        ("table_tennis --out ball.c", "end in .h"),
        ("table_tennis --out 1.h", "letter"),
        ("table_tennis --ball golf --out ball.h", "ball must come with a model file"),
    ],
)
def test_refused(
    words: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert status("export", *words.split()) == 2
    assert said in capsys.readouterr().err.lower().replace("\n", " ")
    assert not list(tmp_path.iterdir())


def test_other_python_is_refused() -> None:
    routine = Routine.of_source("odd", "def odd(x):\n    with x:\n        pass\n", {})
    with pytest.raises(UntranslatableError, match="with x"):
        Translator("ball").made(routine, [None])
