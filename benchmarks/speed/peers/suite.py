"""Runs `ballfg-bench speed --peers`: the same problems by every installed library, in turns."""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from ballfg.arrays import Array
from ballfg.benchmarks.metrics import median_and_quartiles
from ballfg.benchmarks.results import Results
from ballfg.benchmarks.speed import suite as flight
from ballfg.benchmarks.speed.banded import STEP_SIGMA, BandedProblem
from ballfg.benchmarks.speed.network import NetworkFlight, fitted_network
from ballfg.benchmarks.speed.peers.problem import LOSS_STEPS, Problem
from ballfg.benchmarks.speed.robot import NO_SURFACE, path_of
from ballfg.benchmarks.speed.stopwatch import milliseconds
from ballfg.progress import progress
from ballfg.state import STANDARD_GRAVITY
from ballfg.tracks.track import SPIN_LABELS

WORKER: Final = Path(__file__).with_name("worker.py")


class LibraryError(Exception):
    """A library is missing, or does not solve this problem."""


class Session:
    """A running process, which `close` ends.

    Args: python: command that starts the library's interpreter.  task: "estimate" or "rollout".

    Attributes:
        cold: s from the start of the process to its first solution.
        first: s of the first solution, with everything that is compiled for it.
        peak: MiB, the process's largest memory so far.

    Raises: LibraryError: if the library cannot do it.
    """

    def __init__(self, python: Sequence[str], library: str, task: str, problem: Path) -> None:
        begun = time.perf_counter()
        environment = os.environ | {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        self._process = subprocess.Popen(
            [*python, str(WORKER), library, task, str(problem)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=environment,
        )
        self._library = library
        try:
            answer = self._answer()
        except LibraryError:
            self.close()
            raise
        self.cold = time.perf_counter() - begun
        self.first, self.peak = float(answer["first"]), 0.0

    def times(self, count: int) -> list[float]:
        """S of so many solutions, one after another."""
        answer = self._ask(str(count))
        self.peak = float(answer["peak"])
        return [float(t) for t in answer["times"]]

    def solution(self, folder: Path) -> dict[str, Array]:
        """The last solution by name: position m and velocity m/s (t, n, 3) with spin (t, 3) rad/s, or states (k, 9)."""
        path = folder / f"{self._library}-{id(self)}.npz"
        self._ask(str(path))
        with np.load(path) as file:
            return {name: file[name] for name in file.files}

    def _ask(self, line: str) -> dict[str, Any]:
        assert self._process.stdin is not None
        self._process.stdin.write(f"{line}\n")
        self._process.stdin.flush()
        return self._answer()

    def _answer(self) -> dict[str, Any]:
        """The next line of JSON; libraries print lines of their own between."""
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.startswith("{"):
                answer: dict[str, Any] = json.loads(line)
                if "error" in answer:
                    raise LibraryError(f"{self._library}: {answer['error']}")
                return answer
        assert self._process.stderr is not None
        last = self._process.stderr.read().strip().splitlines()[-1:]
        raise LibraryError(f"{self._library} ended: {' '.join(last) or 'without a word'}")

    def close(self) -> None:
        """Ends the process."""
        self._process.kill()
        self._process.communicate()


OWN: Final = ("ballfg", "gtsam")  # Libraries of this environment
PEERS: Final = ("jaxls", "theseus", "pypose")  # Libraries of other environments
MOST_TRACKS: Final = 64
SAME: Final = 1e-6
"""Largest difference from the reference, over the largest number of its kind, up to which a solution is the same."""
DIFFERENCE_STEPS: Final = (1e-4, 1e-5)  # Steps of the central differences by the drag, 1/m, and the Magnus coefficient


@dataclass(frozen=True)
class Task:
    """A problem for all libraries.

    Attributes:
        name: of the rows' case.  kind: "estimate", "gradient" or "rollout".
        network: True if the acceleration is the network's.  tracks: number of them.
        turns, runs: timed solutions: so many turns of so many runs of each library.
    """

    name: str
    kind: str
    network: bool
    tracks: int
    turns: int
    runs: int


TASKS: Final = (
    Task("A", "estimate", False, 1, 6, 20),
    Task("B", "estimate", True, 1, 6, 10),
    Task("64 x A", "estimate", False, 64, 3, 3),
    Task("64 x B", "estimate", True, 64, 3, 2),
    Task("gradient", "gradient", False, 1, 4, 8),
    Task("rollout", "rollout", True, 1, 4, 10),
)


def run_peers(results: Results, peers: Mapping[str, Path], size: flight.Size) -> None:
    """Times of all libraries on all tasks; missing or deviating ones are reported on stderr, without a row.

    Args:
        peers: interpreters of other environments, by library.
        size: how well the network is fitted, and whether this is a quick look.
    """
    for library, python in peers.items():
        if library not in PEERS:
            raise ValueError(
                f"--peer must be of {', '.join(PEERS)}; got {library!r}. Write --peer jaxls=PATH_TO_PYTHON."
            )
        if not python.is_file():
            raise ValueError(f"--peer {library} must be the path of a Python interpreter; {python} is no file.")
    pythons = {**{name: [sys.executable] for name in OWN}, **{name: [str(p)] for name, p in peers.items()}}
    fitted = fitted_network(flight.problem_model(), size.fit_iterations)
    analytic, network = _problem(None), _problem(fitted)
    with tempfile.TemporaryDirectory() as folder:
        for task in progress(TASKS, len(TASKS), "problems solved"):
            whole = network if task.network else analytic
            problem = replace(whole, measured=whole.measured[: task.tracks], label=whole.label[: task.tracks])
            _run_task(results, task, problem, pythons, Path(folder))


def _problem(network: NetworkFlight | None) -> Problem:
    """The track of the speed benchmark, and others that differ from it in their noise."""
    model, rng = flight.problem_model(), np.random.default_rng(1)
    track = flight.problem_track(model)
    truth = path_of(model, flight.START, track.times, NO_SURFACE)
    others = [truth + flight.NOISE * rng.standard_normal(truth.shape) for _ in range(MOST_TRACKS - 1)]
    label = np.tile([track.labels[name] for name in SPIN_LABELS], (MOST_TRACKS, 1))
    layers = [np.zeros((0, 0)), np.zeros(0)] * 3
    if network is not None:
        pairs = zip(network.weights, network.biases, strict=True)
        layers = [part.detach().numpy() for pair in pairs for part in pair]
    sizes = [np.asarray(size) for size in (1.0 / flight.RATE, flight.NOISE, flight.LABEL_NOISE)]
    laws = [np.array((0.0, 0.0, -STANDARD_GRAVITY)), np.asarray(flight.DRAG), np.asarray(flight.MAGNUS)]
    rest = (*sizes, STEP_SIGMA, *laws, *layers, np.array(flight.START))
    return Problem(np.stack([track.positions, *others]), label, *rest)


def _run_task(
    results: Results, task: Task, problem: Problem, pythons: Mapping[str, Sequence[str]], folder: Path
) -> None:
    path = folder / f"{task.name.replace(' ', '')}.npz"
    problem.save(path)
    control = _banded(problem, 0, float(problem.drag), float(problem.magnus))
    with ExitStack() as stack:
        sessions = {}
        for library, python in pythons.items():
            try:
                sessions[library] = stack.enter_context(closing(Session(python, library, task.kind, path)))
            except LibraryError as error:
                print(f"note: {task.name}: {error}", file=sys.stderr)
        reference = _reference(task, problem, path, sessions["ballfg"])
        times: dict[str, list[float]] = {library: [] for library in sessions}
        controls = []
        for _ in range(task.turns):
            controls += [milliseconds(control.solve) for _ in range(5)]
            for library, session in sessions.items():
                times[library] += [1e3 * t for t in session.times(task.runs)]
        results.add(task.name, "control", "banded_time", "ms", median_and_quartiles(controls), len(controls))
        for library, session in sessions.items():
            found = session.solution(folder)  # of each kind of numbers the largest difference over the largest number
            off = max(float(np.abs(found[name] - x).max() / np.abs(x).max()) for name, x in reference.items())
            results.add(task.name, library, "difference", "1", off, 1)
            if off > SAME and task.kind != "gradient":
                print(f"note: {task.name}: {library} is {off:.1e} away from the minimum: no time", file=sys.stderr)
                continue
            figure = median_and_quartiles(times[library])
            results.add(task.name, library, "time", "ms", figure, len(times[library]))
            results.add(task.name, library, "compile_time", "s", max(session.first - 1e-3 * figure.value, 0.0), 1)
            results.add(task.name, library, "cold_start", "s", session.cold, 1)
            results.add(task.name, library, "memory", "MiB", session.peak, 1)


def _reference(task: Task, problem: Problem, path: Path, own: Session) -> dict[str, Array]:
    """Reference solutions: the banded solver's, and GTSAM's to the last digits for the network.

    Of gradients central differences of the banded solver, of rollouts ballfg's own, which the others must meet.
    """
    if task.kind == "rollout":
        return own.solution(path.parent)
    if task.network:
        with closing(Session([sys.executable], "gtsam", "reference", path)) as session:
            return session.solution(path.parent)
    if task.kind == "gradient":
        return {"gradient": np.array([_slope(problem, which) for which in range(2)])}
    laws = float(problem.drag), float(problem.magnus)
    solved = [_banded(problem, k, *laws).solve() for k in range(task.tracks)]
    states = np.stack([states for states, _, _ in solved])
    return {"position": states[..., :3], "velocity": states[..., 3:], "spin": np.stack([spin for _, spin, _ in solved])}


def _banded(problem: Problem, track: int, drag: float, magnus: float) -> BandedProblem:
    noise = float(problem.position_sigma), problem.label[track], float(problem.label_sigma)
    return BandedProblem(problem.measured[track], float(problem.dt), *noise, drag, magnus)


def _slope(problem: Problem, which: int) -> float:
    """Derivative of the loss by the drag or the Magnus coefficient: central differences of fourth order."""
    laws = np.array((float(problem.drag), float(problem.magnus)))

    def loss(shift: float) -> float:
        drag, magnus = laws + shift * DIFFERENCE_STEPS[which] * np.eye(2)[which]
        states, spin, _ = _banded(problem, 0, drag, magnus).solve()
        p, v, dt = states[-1, :3], states[-1, 3:], float(problem.dt)
        for _ in range(LOSS_STEPS):
            a = problem.gravity - drag * np.sqrt(v @ v) * v + magnus * np.cross(spin, v)
            p, v = p + dt * v + 0.5 * dt**2 * a, v + dt * a
        return float(p @ p)

    return (8.0 * (loss(1.0) - loss(-1.0)) - (loss(2.0) - loss(-2.0))) / (12.0 * DIFFERENCE_STEPS[which])
