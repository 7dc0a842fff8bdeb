"""Draws overview.png of the README: `.venv/bin/python docs/pictures/overview.py`."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch

from ballfg.dynamics import Surfaces, nominal_model
from ballfg.estimation import Settings, Smoother, predict_tracks
from ballfg.simulation import MeasurementNoise, SimulationConfig, simulate

OBSERVED = 0.25  # s
NINETY = 1.645  # standard deviations on either side that hold 90 %


def main() -> None:
    """One simulated shot: samples, the smoother's track, a prediction and how far it can be trusted."""
    torch.set_num_threads(1)
    noise = MeasurementNoise(position=0.004, outliers=0.04, outlier_size=0.06)
    config = SimulationConfig(
        tracks=1,
        seed=21,
        rate=120.0,
        noise=noise,
        settings={"topspin": (1,), "sidespin": (3,), "speed": (12,)},
        spin_labels=False,
    )
    shot = next(iter(simulate(config)))
    track, truth = shot.track, shot.true_states
    model, surfaces = nominal_model(), Surfaces.table_tennis(0.76)
    smoother = Smoother(model, surfaces, Settings.for_measured(model, position_noise=(0.004,) * 3))
    estimate = smoother.estimate(track)
    (prediction,) = predict_tracks(smoother, [track], 1, OBSERVED)
    figure, (side, spread) = plt.subplots(1, 2, figsize=(11, 3.9), width_ratios=(1.7, 1), layout="constrained")

    seen = track.times <= track.times[0] + OBSERVED
    side.axhspan(0.70, 0.76, color="0.85")
    side.text(0.05, 0.715, "table", color="0.45")
    side.plot(*track.positions[seen][:, [0, 2]].T, ".", color="#1f77b4", ms=5, label=f"samples, first {OBSERVED:g} s")
    side.plot(*track.positions[~seen][:, [0, 2]].T, ".", color="0.6", ms=4, label="samples, later")
    side.plot(*estimate.states[:, [0, 2]].T, color="#1f77b4", lw=1, label="smoother, whole track")
    x, z = prediction.positions[:, 0], prediction.positions[:, 2]
    half = NINETY * prediction.sigmas[:, 2]
    side.plot(x, z, color="#d62728", lw=1.4, label=f"predicted from the first {OBSERVED:g} s")
    side.fill_between(x, z - half, z + half, color="#d62728", alpha=0.2, lw=0, label="90 % of samples expected")
    side.set(xlabel="x / m", ylabel="z / m", title="One simulated shot, sidespin, no spin label", ylim=(0.7, None))
    side.legend(fontsize=8, loc="upper right")

    error = np.linalg.norm(prediction.positions - truth[len(truth) - len(x) :, :3], axis=1)
    after = prediction.times - track.times[0] - OBSERVED
    sigma = np.linalg.norm(np.sqrt(np.maximum(prediction.sigmas**2 - 0.004**2, 0.0)), axis=1)
    spread.plot(1e3 * after, 1e3 * error, color="#d62728", label="error of the prediction")
    spread.plot(1e3 * after, 1e3 * sigma, "--", color="0.3", label="its own standard deviation")
    for contact in estimate.contacts:
        spread.axvline(1e3 * (contact.time - track.times[0] - OBSERVED), color="0.7", lw=0.8)
    spread.set(
        xlabel="time ahead / ms",
        ylabel="position / mm",
        title="How far ahead it can be trusted",
        xlim=(0, None),
        ylim=(0, None),
    )
    spread.legend(fontsize=8, loc="upper left", title="grey lines: bounces", title_fontsize=8)
    figure.savefig(Path(__file__).with_suffix(".png"), dpi=130)


if __name__ == "__main__":
    main()
