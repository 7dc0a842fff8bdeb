"""Estimates by GTSAM's solver beside those by the package's own, on measured and simulated tracks.

    python -m tests.estimation.gtsam_solver --data --simulated 200 --seed 7

prints for each dataset of measured tracks, and for simulated tracks, how far the two are apart in posterior standard
deviations, and names the tracks that are further apart than 1e-5. The package's own solver leaves a last step out where
it foretells one shorter than its tolerance of 1e-5, and may then be several times that from the minimum. So estimates
are compared with its minimum to 1e-8 as well, which shows which of the two solvers is off.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import ballfg as bf
from ballfg.estimation import dataset_surfaces
from ballfg.estimation.configure import fitted_settings
from ballfg.factors import LevenbergMarquardt
from ballfg.simulation import SimulationConfig
from ballfg.tracks import Track
from tests.places import DATA

SAME = 1e-5
"""Posterior standard deviations."""
RATE = 120.0
"""Hz, of simulated tracks."""


@dataclass(frozen=True)
class Difference:
    """How one track's estimates differ.

    Attributes:
        name: of the track.  samples: of it.
        apart: the largest distance of two states, and of the coefficients, in posterior standard deviations.
        own, gtsam: the same of either from the minimum that the own solver finds to 1e-8.
        higher: by how much GTSAM's objective lies above.
        status: of both.  contacts: of both.
        seconds: of both.
    """

    name: str
    samples: int
    apart: float
    own: float
    gtsam: float
    higher: float
    status: tuple[str, str]
    contacts: tuple[int, int]
    seconds: tuple[float, float]

    def __str__(self) -> str:
        return (
            f"{self.name} ({self.samples} samples): {self.apart:.1e} sigma apart, own {self.own:.1e} and "
            f"gtsam {self.gtsam:.1e} from the minimum, objective {self.higher:+.1e}, "
            f"{' / '.join(self.status)}, contacts {self.contacts[0]} / {self.contacts[1]}"
        )


@dataclass(frozen=True)
class Solvers:
    """The smoother with the package's own solver, as it is and to 1e-8, and with GTSAM's."""

    own: bf.Smoother
    tight: bf.Smoother
    gtsam: bf.Smoother

    @classmethod
    def of(cls, model: bf.AnalyticModel, surfaces: bf.Surfaces, settings: bf.Settings) -> Solvers:
        """For one ball, room and noise."""
        given = model, surfaces
        other = replace(settings, solver="gtsam")
        return cls(
            bf.Smoother(*given, settings),
            bf.Smoother(*given, settings, LevenbergMarquardt(tolerance=1e-8)),
            bf.Smoother(*given, other),
        )


def difference(solvers: Solvers, track: Track) -> Difference:
    """How the estimates of the solvers differ."""
    begin = time.process_time()
    one = solvers.own.estimate(track)
    middle = time.process_time()
    two = solvers.gtsam.estimate(track)
    end = time.process_time()
    minimum = solvers.tight.estimate(track)
    return Difference(
        track.name,
        len(track),
        distance(one, two),
        distance(minimum, one),
        distance(minimum, two),
        two.error - one.error,
        (one.status.name, two.status.name),
        (len(one.contacts), len(two.contacts)),
        (middle - begin, end - middle),
    )


def distance(one: bf.Estimate, two: bf.Estimate) -> float:
    """The largest distance of two states of a track, and of its coefficients, in the first one's sigmas."""
    apart = mahalanobis(one.states - two.states, one.covariances)
    if one.coefficient_names:
        shared = mahalanobis((one.coefficients - two.coefficients)[None], one.coefficient_covariance[None])
        apart = np.append(apart, shared)
    return float(apart.max())


def mahalanobis(apart: np.ndarray, covariances: np.ndarray) -> np.ndarray:
    """(n,) distances of differences (n, d) in the standard deviations of covariances (n, d, d)."""
    return np.asarray(np.linalg.norm(np.linalg.solve(np.linalg.cholesky(covariances), apart[..., None]), axis=(1, 2)))


def measured(folder: Path, count: int) -> Iterable[Difference]:
    """Up to `count` tracks of a dataset, spread over it."""
    data = bf.read(folder)
    model = bf.nominal_model(data.ball)
    solvers = Solvers.of(model, dataset_surfaces(data), fitted_settings(data, model))
    step = max(1, len(data) // count)
    return (difference(solvers, track) for k, track in enumerate(data) if k % step == 0)


def simulated(count: int, seed: int) -> Iterable[Difference]:
    """Simulated shots of a table-tennis ball, every other without its spin label."""
    config = SimulationConfig(tracks=count, rate=RATE, seed=seed)
    model = bf.nominal_model()
    settings = bf.Settings.for_measured(model, position_noise=(0.003,) * 3)
    solvers = Solvers.of(model, config.ball.surfaces, settings)
    for k, shot in enumerate(bf.simulate(config)):
        yield difference(solvers, replace(shot.track, labels={}) if k % 2 else shot.track)


def report(name: str, found: Iterable[Difference]) -> list[Difference]:
    """Prints what was found, and returns those that are too far apart."""
    every = list(found)
    apart, seconds = np.array([one.apart for one in every]), np.array([one.seconds for one in every])
    wrong = [one for one in every if not one.apart <= SAME]
    own, by_gtsam = max(one.own for one in every), max(one.gtsam for one in every)
    print(
        f"{name}: {len(every)} tracks, {len(wrong)} further apart than {SAME:g} sigma; median {np.median(apart):.1e}; "
        f"from the minimum own {own:.1e} at most, gtsam {by_gtsam:.1e}; median CPU time "
        f"{1e3 * np.median(seconds[:, 0]):.0f} and {1e3 * np.median(seconds[:, 1]):.0f} ms",
        flush=True,
    )
    for one in wrong:
        print(f"  {one}", flush=True)
    return wrong


def main() -> None:
    """Compares the solvers on all datasets of a folder and on simulated tracks."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--data", type=Path, nargs="?", const=DATA, help="folder of datasets")
    parser.add_argument("--count", type=int, default=10**6, help="tracks of each dataset")
    parser.add_argument("--simulated", type=int, default=200)
    parser.add_argument("--seed", type=int, default=7)
    chosen = parser.parse_args()
    files = sorted(chosen.data.glob("*/dataset.yaml")) if chosen.data else []
    if chosen.data and not files:
        parser.error(f"there are no datasets in {chosen.data}")
    for file in files:
        report(file.parent.name, measured(file.parent, chosen.count))
    if chosen.simulated:
        report("simulated", simulated(chosen.simulated, chosen.seed))


if __name__ == "__main__":
    main()
