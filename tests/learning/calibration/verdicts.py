"""Verdict and exit status of calibrations on simulated sets with and without something to gain.

    python -m tests.learning.calibration.verdicts --count 40 --seed 100

Every second set has a drag or a restitution that the declared model does not know; the others are that model's. Right
is `better` with the status 0, and `no different` with the status 1.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import tempfile
from pathlib import Path

import numpy as np

from ballfg.learning.cli import run
from tests.commands import status


def calibrated(seed: int, gains: bool, folder: Path) -> tuple[int, str]:
    """The exit status and the outcome of a calibration of 24 simulated shots."""
    rng = np.random.default_rng(seed)
    change = ("drag.k", f"{0.13 * (1.0 + rng.choice((-1, 1)) * rng.uniform(0.25, 0.5)):.4f}")
    if rng.random() < 0.5:
        change = ("restitution.e", f"{rng.uniform(0.75, 0.85):.3f}")
    effect = ("--effect", "=".join(change)) if gains else ()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        assert status("simulate", "--out", folder / "set", "--tracks", 24, "--seed", seed, *effect) == 0
        config = folder / "cal.yaml"
        config.write_text(f"{{kind: calibrate, model: {folder / 'set' / 'model.yaml'}}}")
        try:
            run([str(config), "--data", str(folder / "set"), "--out", str(folder / "run")])
        except SystemExit as ended:
            code = ended.code
    report = json.loads((folder / "run" / "report.json").read_text())
    return int(code or 0), report["judged"]["outcome"]


def main() -> None:
    """Prints each set and how many are right."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--seed", type=int, default=100)
    chosen = parser.parse_args()
    right = 0
    for seed in range(chosen.seed, chosen.seed + chosen.count):
        gains = seed % 2 == 0
        with tempfile.TemporaryDirectory() as folder:
            found = calibrated(seed, gains, Path(folder))
        right += found == ((0, "better") if gains else (1, "no different"))
        print(f"{seed} {'something' if gains else 'nothing'} to gain: {found[1]}, status {found[0]}", flush=True)
    print(f"{right} of {chosen.count} verdicts and statuses right")


if __name__ == "__main__":
    main()
