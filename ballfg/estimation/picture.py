"""Plots the components of an estimate or a prediction over time, with their uncertainty."""

from typing import Final

import numpy as np
from matplotlib.figure import Figure

from ballfg.checks import drawn
from ballfg.estimation.result import Estimate
from ballfg.estimation.track_prediction import TrackPrediction
from ballfg.pages.pictures import by_axis
from ballfg.pages.shot import Mark, ShownShot
from ballfg.state import VELOCITY

PARTS: Final = (("position", "m"), ("velocity", "m/s"), ("spin", "rad/s"))
AXES: Final = ("x", "y", "z")
COLOURS: Final = ("#c44e52", "#55a868", "#4c72b0")


def picture(estimate: Estimate) -> Figure:
    """Three panels, one for each part of the state; contacts are dashed lines, hits are dotted ones.

    Nothing is drawn in steps of more than `gap` of a shot, nor velocity and spin of samples that are left as measured.
    """
    figure = Figure(figsize=(8.0, 7.0), layout="constrained")
    panels = figure.subplots(3, 1, sharex=True)
    times, states = estimate.times, estimate.states.copy()
    unmoved = (states[:, VELOCITY.start :] == 0.0).all(
        axis=1
    )  # left as measured, as of a held ball: no motion is known
    states[unmoved, VELOCITY.start :] = np.nan
    at, means, sigmas = ShownShot(estimate.name, state_times=times).broken(times, states, estimate.sigmas)
    for k, (part, unit) in enumerate(PARTS):
        for axis in range(3):
            column = 3 * k + axis
            mean, band = means[:, column], 2.0 * sigmas[:, column]
            panels[k].plot(at, mean, color=COLOURS[axis], label=AXES[axis], linewidth=1.2)
            panels[k].fill_between(at, mean - band, mean + band, color=COLOURS[axis], alpha=0.2, linewidth=0.0)
        for contact in estimate.contacts:
            panels[k].axvline(contact.time, color="0.5", linestyle="--", linewidth=0.8)
        for interval in estimate.hits:
            panels[k].axvline(0.5 * (times[interval] + times[interval + 1]), color="0.5", linestyle=":", linewidth=0.8)
        panels[k].set_ylabel(f"{part}, {unit}")
        panels[k].grid(alpha=0.3)
    panels[0].legend(ncols=3, loc="upper right")
    panels[0].set_title(f"track {drawn(estimate.name)}: states with two standard deviations; dashed: contacts")
    panels[2].set_xlabel("time, s")
    return figure


def predicted(prediction: TrackPrediction) -> Figure:
    """Three panels, one for each axis; contacts of the observed part are dashed lines, hits are dotted ones."""
    estimate, times, marks = prediction.estimate, prediction.estimate.times, []
    events = [("contact", contact.time) for contact in estimate.contacts]
    events += [("hit", float(0.5 * (times[interval] + times[interval + 1]))) for interval in estimate.hits]
    for kind, time in events:
        x, y, z = (float(np.interp(time, times, path)) for path in estimate.states[:, :3].T)
        marks.append(Mark(kind, time, (x, y, z)))
    unknown = np.full(prediction.measured.shape, np.nan)
    seen = (times, estimate.states, estimate.sigmas)
    ahead = (prediction.times, prediction.positions, prediction.sigmas)
    measured = (prediction.times, prediction.measured, unknown)
    return by_axis(ShownShot(prediction.name, *measured, *seen, *ahead, tuple(marks)))
