"""Odd tracks, with a fixed seed: wild ones, which no ball flies, and real shots that were measured badly.

`python -m tests.faults.odd_tracks --count 1000` estimates, predicts and diagnoses so many of each sort, and prints what
went wrong. The exit status is 1 where something raised, was not finite, or was wrong and called converged.
"""

import argparse
import sys
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ballfg.arrays import Array
from ballfg.dynamics import Surfaces, nominal_model
from ballfg.estimation import Estimate, Estimator, Settings, Status
from ballfg.estimation.filters.window_velocity import WINDOW
from ballfg.estimation.registry import make_estimator
from ballfg.estimation.track_prediction import predict_tracks
from ballfg.simulation import MeasurementNoise, SimulationConfig, simulate
from ballfg.state import POSITION, STANDARD_GRAVITY
from ballfg.tracks import TABLE_TENNIS, Track
from ballfg.tracks.checks import check_scale
from ballfg.tracks.dataset import dataset_in_memory
from ballfg.tracks.info import DatasetInfo
from ballfg.tracks.track import SPIN_LABELS

METHODS = ("smoother", "online", "ekf", "sliding-window")
TABLE_HEIGHT = 0.76
INFO = DatasetInfo("odd", TABLE_HEIGHT, TABLE_TENNIS, None, 0.003)
OBSERVED = 0.25
"""s from the start of each track that a prediction sees."""
AHEAD = 0.5
"""s after that, up to which it goes."""
OUTLIER = 0.05
"""m from the truth, beyond which a simulated sample is an outlier."""
FAR = 20.0
"""Standard deviations. An estimate that is farther from the truth is wrong, whatever chance does."""


@dataclass(frozen=True)
class Odd:
    """A track, and the true states (n, 9) at its samples where there are any."""

    track: Track
    truth: Array | None = None


def wild(count: int, seed: int = 0, longest: float = np.inf) -> Iterator[Odd]:
    """Tracks of which the reader accepts the numbers, and nothing more can be said.

    Args: count: tracks.  seed: the same seed gives the same tracks.  longest: s, gap; a ball is followed through all.
    """
    made = 0
    for number in range(20 * count):
        rng = np.random.default_rng((seed, number))
        track = _wild(rng, f"wild{made}")
        if _readable(track) and float(np.diff(track.times).max()) <= longest:
            yield Odd(track)
            made += 1
        if made == count:
            return


def _readable(track: Track) -> bool:
    try:
        check_scale("track", track.times, track.positions, track.sigmas, None)
    except ValueError:
        return False
    return True


def _wild(rng: np.random.Generator, name: str) -> Track:
    n = int(rng.choice([2, 3, 4, 5, int(rng.integers(6, 40))], p=[0.1, 0.1, 0.1, 0.1, 0.6]))
    times, positions = _stamps(rng, n), np.zeros((n, 3))
    sort = rng.integers(8)
    if sort == 0:  # a ball that never moves
        positions[:] = rng.uniform(-3, 3, 3)
    elif sort == 1:  # along one axis, the others exactly zero
        positions[:, rng.integers(3)] = np.cumsum(rng.normal(0, 1, n)) * rng.choice([1e-9, 1e-3, 0.1, 3.0])
    elif sort == 2:  # as fast as the reader allows
        positions = times[:, None] * rng.normal(0, rng.choice([1.0, 30.0, 150.0]), 3)
    elif sort == 3:  # a flight of gravity alone, from anywhere
        positions = rng.normal(0, 1, 3) + (times - times[0])[:, None] * rng.normal(0, 8, 3)
        positions[:, 2] -= 0.5 * STANDARD_GRAVITY * (times - times[0]) ** 2
    elif sort == 4:  # noise about a place
        positions = rng.normal(0, rng.choice([1e-6, 1e-2, 1.0, 40.0]), (n, 3))
    elif sort == 5:  # a random walk
        positions = np.cumsum(rng.normal(0, rng.choice([1e-3, 0.1, 1.0]), (n, 3)), axis=0)
    elif sort == 6:  # in place, with jumps
        positions[:] = rng.normal(0, 1, 3)
        positions[n // 2 :] += rng.normal(0, rng.choice([0.1, 10.0, 80.0]), 3)
    else:  # far below or above all surfaces
        positions = rng.normal(0, 0.1, (n, 3))
        positions[:, 2] += rng.choice([-200.0, -1.0, 0.76, 0.78, 200.0])
    if rng.random() < 0.3:
        rows = rng.random(n) < 0.2
        positions[rows] += rng.normal(0, rng.choice([1.0, 30.0, 100.0]), (int(rows.sum()), 3))
    if rng.random() < 0.2 and n > 2:
        positions[1:][rng.random(n - 1) < 0.5] = positions[0]
    sigmas = None
    if rng.random() < 0.4:
        sigmas = np.full((n, 3), rng.choice([1e-9, 1e-6, 1e-4, 0.1, 1.0])) * rng.uniform(0.5, 1.0, (n, 3))
        if rng.random() < 0.3:
            sigmas[rng.integers(n)] *= rng.choice([1e-3, 1e6, 1e12])
    return Track(times, positions, sigmas, _wild_labels(rng), name)


def _stamps(rng: np.random.Generator, n: int) -> Array:
    shares = [0.1, 0.2, 0.3, 0.2, 0.1, 0.06, 0.04]
    steps = np.full(n - 1, rng.choice([1e-5, 1e-3, 0.01, 1 / 15, 0.25, 0.667, 1.0], p=shares))
    kind = rng.integers(4)
    if kind == 1:
        steps *= rng.uniform(0.1, 2.0, n - 1)
    elif kind == 2:
        steps = np.minimum(steps * 10.0 ** rng.uniform(-3, 2, n - 1), 2.0)
    elif kind == 3:
        steps[rng.integers(n - 1)] *= rng.choice([1e-4, 30.0, 1e4])
    start = rng.choice([0.0, -50.0, 1.7e9])
    return np.asarray(start + np.concatenate(([0.0], np.cumsum(np.maximum(steps, 2e-6)))))


def _wild_labels(rng: np.random.Generator) -> dict[str, float]:
    if rng.random() < 0.7:
        return {}
    spin = rng.normal(0, rng.choice([1.0, 100.0, 900.0]), 3).clip(-1100.0, 1100.0)
    return dict(zip(SPIN_LABELS, map(float, spin), strict=True))


def realistic(count: int, seed: int = 0) -> Iterator[Odd]:
    """Simulated shots, badly measured or badly labelled; balls that rest; balls that are dropped.

    Args: count: tracks.  seed: the same seed gives the same tracks.
    """
    rates, share = (15.0, 60.0, 120.0, 240.0), -(-count // 5)
    shots: list[Odd] = []
    for k, rate in enumerate(rates):
        outliers, dropout = (0.0, 0.0) if k == 0 else (0.03, 0.3)
        noise = MeasurementNoise(dropout=dropout, outliers=outliers, outlier_size=0.3)
        for one in simulate(SimulationConfig(tracks=share, rate=rate, seed=seed + k, noise=noise)):
            shots.append(Odd(one.track, one.true_states))
    quiet = [still(np.random.default_rng((seed, 99, k)), dropped=k % 2 == 0) for k in range(share)]
    groups = [shots[k * share : (k + 1) * share] for k in range(len(rates))] + [quiet]
    mixed = [group[k] for k in range(share) for group in groups][:count]
    for k, odd in enumerate(mixed):
        yield Odd(replace(_mislabelled(odd.track, k, seed), name=f"real{k}"), odd.truth)


def _mislabelled(track: Track, number: int, seed: int) -> Track:
    """Every third track loses its spin label; every seventh has one of another shot."""
    if number % 3 == 0:
        return replace(track, labels={key: value for key, value in track.labels.items() if key not in SPIN_LABELS})
    if number % 7 == 0 and track.spin_label is not None:
        wrong = np.random.default_rng((seed, 7, number)).normal(0, 200.0, 3)
        return replace(track, labels={**track.labels, **dict(zip(SPIN_LABELS, map(float, wrong), strict=True))})
    return track


def still(rng: np.random.Generator, *, dropped: bool) -> Odd:
    """A ball that is dropped onto the table with x = y = 0 exactly, or one that lies there."""
    times = np.arange(int(rng.integers(10, 80))) / rng.choice([60.0, 120.0])
    truth, low = np.zeros((len(times), 9)), TABLE_HEIGHT + TABLE_TENNIS.radius
    truth[:, 2] = low
    positions = truth[:, POSITION]
    if dropped:
        truth[:, 2], truth[:, 5] = _bouncing(times, rng.uniform(0.2, 1.5))
        truth[:, 2] += low
    positions = truth[:, POSITION].copy()
    positions[:, 2] += rng.normal(0, 0.002, len(times))
    if not dropped:
        truth[:, :2] = rng.uniform(-0.5, 0.5, 2)
        positions[:, :2] = truth[:, :2] + rng.normal(0, 0.002, (len(times), 2))
    return Odd(Track(times, positions), truth)


def _bouncing(times: Array, height: float, restitution: float = 0.9) -> tuple[Array, Array]:
    """Height (n,) m and vertical velocity (n,) m/s of a ball without drag that is dropped from a height (m)."""
    z, v = np.empty(len(times)), np.empty(len(times))
    for k, t in enumerate(times):
        start, up = -np.sqrt(2.0 * height / STANDARD_GRAVITY), np.sqrt(2.0 * height * STANDARD_GRAVITY)
        while t > start + 2.0 * up / STANDARD_GRAVITY:
            start, up = start + 2.0 * up / STANDARD_GRAVITY, restitution * up
        z[k], v[k] = up * (t - start) - 0.5 * STANDARD_GRAVITY * (t - start) ** 2, up - STANDARD_GRAVITY * (t - start)
    return z, v


def estimator_of(method: str) -> Estimator:
    """The estimator of a name, for a table-tennis ball above its table."""
    model = nominal_model(TABLE_TENNIS)
    settings = Settings.for_measured(model, position_noise=(0.003,) * 3)
    return make_estimator(method, model, Surfaces.table_tennis(TABLE_HEIGHT), settings)


@dataclass
class Tally:
    """What happened to tracks that were estimated and predicted by one method."""

    tracks: int = 0
    raised: int = 0
    not_finite: int = 0
    ok: int = 0
    judged: int = 0
    far: int = 0
    warned: int = 0

    def add(self, odd: Odd, estimate: Estimate | None, predicted: tuple[Array, Array] | None) -> str:
        """Counts a track.

        Args: predicted: states (k, 9) and covariances (k, 9, 9).
        Returns: what is wrong with it; nothing where nothing is.
        """
        self.tracks += 1
        if estimate is None or predicted is None:
            self.raised += 1
            return "raised"
        good = sound(estimate.states, estimate.covariances) and sound(*predicted)
        if estimate.coefficient_names and len(estimate.coefficients):
            good &= sound(estimate.coefficients[None], estimate.coefficient_covariance[None])
            joint = np.array([estimate[k].joint for k in (0, len(estimate) - 1)])
            good &= sound(np.zeros((2, joint.shape[1])), joint)
        self.not_finite += not good
        wrong = [] if good else ["not finite or not positive definite"]
        if estimate.status is Status.OK:
            self.ok += 1
            if odd.truth is not None:
                self.judged += 1
                off = np.abs(estimate.states - odd.truth) / estimate.sigmas
                farthest = float((off[:, :6] * _fairly_judged(odd, estimate)[:, None]).max())
                far = farthest > FAR
                self.far += far
                wrong += [f"OK and {farthest:.0f} sigma off"] if far else []
        return ", ".join(wrong)


def _fairly_judged(odd: Odd, estimate: Estimate) -> Array:
    """(n,) one where positions and velocities are judged, zero in windows with an outlier of the sliding window.

    It takes them for measurements like others; all other estimators have to find them.
    """
    assert odd.truth is not None
    if len(estimate.quality):
        return np.ones(len(estimate))
    missed = np.abs(odd.track.positions - odd.truth[:, POSITION]).max(axis=1) > OUTLIER
    recent = np.convolve(missed, np.ones(WINDOW))[: len(missed)]
    return np.asarray((recent == 0.0).astype(np.float64))


def sound(means: Array, covariances: Array) -> bool:
    """Whether means (n, d) are finite and covariances (n, d, d) symmetric and positive definite."""
    if not (np.isfinite(means).all() and np.isfinite(covariances).all()):
        return False
    sigma = np.sqrt(np.maximum(np.diagonal(covariances, axis1=1, axis2=2), 0.0))
    if not (sigma > 0.0).all():
        return False
    correlation = covariances / sigma[:, :, None] / sigma[:, None, :]
    try:
        np.linalg.cholesky(correlation)
    except np.linalg.LinAlgError:
        return False
    return bool(np.abs(correlation - correlation.swapaxes(1, 2)).max() < 1e-9)


def judged(estimator: Estimator, odds: list[Odd], *, verbose: bool = False) -> Tally:
    """Every track estimated and predicted by itself.

    Args: verbose: prints each track that went wrong.
    """
    tally = Tally()
    for odd in odds:
        estimate = predicted = None
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                estimate = estimator.estimate(odd.track)
                ahead = estimate.predict(0.3)
                predicted = ahead.states, ahead.covariances
                for one in predict_tracks(estimator, [odd.track], 1, OBSERVED, horizon=AHEAD):
                    if not (np.isfinite(one.positions).all() and np.isfinite(one.sigmas).all()):
                        predicted = np.full((1, 9), np.nan), np.full((1, 9, 9), np.nan)
            except Exception as error:
                estimate = None
                if verbose:
                    where = traceback.extract_tb(error.__traceback__)[-1]
                    print(f"  {odd.track.name}: {type(error).__name__}: {error} ({where.name}:{where.lineno})")
        tally.warned += bool(caught)
        wrong = tally.add(odd, estimate, predicted)
        if verbose and caught:
            print(f"  {odd.track.name}: warned: {caught[0].message} ({caught[0].filename}:{caught[0].lineno})")
        if verbose and wrong and estimate is not None:
            print(f"  {odd.track.name}: {wrong}, {estimate.status.name}, {len(odd.track)} samples")
    return tally


def diagnosed(odds: list[Odd], size: int = 40) -> Counter[str]:
    """Diagnoses of sets of tracks: how many ended how; a refusal in one line is an end like others."""
    from ballfg.diagnosis import diagnose

    ends: Counter[str] = Counter()
    for first in range(0, len(odds), size):
        tracks = [replace(odd.track, sigmas=None) for odd in odds[first : first + size]]
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                found = diagnose(dataset_in_memory(INFO, tracks), nominal_model(TABLE_TENNIS), jobs=1)
                ends[found.verdict.name] += 1
            except ValueError as error:
                plain = not isinstance(error, np.linalg.LinAlgError)
                ends[f"{'refused' if plain else 'raised'}: {error}"] += 1
            except Exception as error:
                ends[f"raised: {type(error).__name__}: {error}"] += 1
        if caught:
            ends[f"warned: {caught[0].message} ({caught[0].filename}:{caught[0].lineno})"] += 1
    return ends


def main() -> int:
    """Runs everything and prints one line for each method and sort of track."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=1000, help="tracks of each sort")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--methods", default=",".join(METHODS))
    parser.add_argument("--sorts", default="wild,realistic")
    parser.add_argument("--diagnoses", type=int, default=200, help="tracks of each sort that are diagnosed, in sets")
    parser.add_argument("--verbose", action="store_true")
    chosen = parser.parse_args()
    bad = 0
    for sort in chosen.sorts.split(","):
        odds = list({"wild": wild, "realistic": realistic}[sort](chosen.count, chosen.seed))
        for method in chosen.methods.split(",") if chosen.methods else ():
            begin = time.perf_counter()
            tally = judged(estimator_of(method), odds, verbose=chosen.verbose)
            print(f"{sort:9s} {method:14s} {tally} in {time.perf_counter() - begin:.0f} s", flush=True)
            bad += tally.raised + tally.not_finite + tally.warned + (tally.far > 0.005 * max(tally.judged, 1))
        ends = diagnosed(odds[: chosen.diagnoses])
        for text, number in ends.most_common():
            print(f"{sort:9s} diagnosis      {number} {text}", flush=True)
        bad += sum(number for text, number in ends.items() if text.startswith(("raised", "warned")))
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
