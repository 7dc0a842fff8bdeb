"""Writes `training.html`, a page that first says whether the training helped."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from ballfg.arrays import Array
from ballfg.learning.run.run_folder import Epoch
from ballfg.learning.trainee import Learned, PredictedShot
from ballfg.pages import html

MEASURED, PREDICTED = "#8c8c8c", "#0072b2"
TERMS = {
    "epoch": "One pass over all training tracks. Epoch 0 is the model before the first step.",
    "validation": "Tracks that the training never learns from. Their errors show what the model does for new tracks.",
    "RMSE": "Root mean square distance between predicted and measured positions.",
    "loss": "The number that the training makes small. Its scale depends on the config; only its course matters.",
    "median": "Of all errors in order of size the one in the middle.",
}
"""Words of the page with their meanings."""


def improved(epochs: Sequence[Epoch], best_epoch: int) -> bool | None:
    """True if the best model predicts validation tracks better than the one before the first step.

    Returns: None if that is unknown: no step was taken, or no validation track was judged.
    """
    judged = [e for e in epochs if e.validation_rmse is not None]
    if not judged or judged[0].epoch != 0 or len(epochs) < 2:
        return None
    return best_epoch > 0


def beside_untrained(epochs: Sequence[Epoch], best_epoch: int, untrained: float | None) -> str:
    """A sentence on the analytic model's error on the same tracks; empty if unknown.

    Args: untrained: RMSE of the analytic model on the validation tracks, m.
    """
    found = {e.epoch: e.validation_rmse for e in epochs}.get(best_epoch)
    if untrained is None or found is None:
        return ""
    said = f"The analytic model alone predicts them to {1e3 * untrained:.1f} mm"
    return f"{said}." if found < untrained else f"{said}, which is better still: train longer, or keep that one."


def verdict(epochs: Sequence[Epoch], best_epoch: int) -> str:
    """A sentence on whether the training helped."""
    better = improved(epochs, best_epoch)
    if better is None:
        return "Whether the training helped is not known: no validation track was judged before and after it."
    errors = {e.epoch: 1e3 * e.validation_rmse for e in epochs if e.validation_rmse is not None}
    if better:
        return (
            f"The training helped: on validation tracks, predictions are off by {errors[best_epoch]:.1f} mm in place "
            f"of {errors[0]:.1f} mm before the first step."
        )
    later = [error for number, error in errors.items() if number]
    least = f"After it the best was {min(later):.1f} mm." if later else "None of the later models could be judged."
    return (
        f"The training did not help: the model before the first step predicts validation tracks best, to "
        f"{errors[0]:.1f} mm. {least}"
    )


def page(
    title: str,
    epochs: Sequence[Epoch],
    best_epoch: int,
    curves: Figure,
    learned: Sequence[Learned],
    shot: PredictedShot | None,
    next_command: str,
    origin: Mapping[str, str],
    beside: str = "",
    doubts: Sequence[str] = (),
) -> str:
    """The whole page.

    Args:
        best_epoch: whose weights were written.
        learned: coefficients and noise before and after.
        shot: a validation track predicted by the written model; None where there is none.
        next_command: the command to type next, or empty.
        origin: date, versions, command: what the page comes from, by its name.
        beside: a sentence on another model's errors, or empty.
        doubts: what is not sure about the tracks.
    """
    first = f"{verdict(epochs, best_epoch)} {beside}".strip()
    caption = "Loss (a pure number) and root mean square errors (mm) after each epoch. An axis of powers of ten is "
    made = [(name, html.typed(said) if name == "command" else said) for name, said in origin.items()]
    made.append(("config", "config.yaml beside this page, with every default"))
    rows = [(o.name, f"{o.before:.4g}", f"{o.after:.4g}", o.unit or "a pure number", o.meaning) for o in learned]
    head = ("number", "before", "after", "unit", "what it is")
    return html.whole_page(
        f"training: {title}",
        html.tag("header", html.tag("p", title), html.tag("h1", first), html.doubtful(doubts)),
        html.section("What to do next", *_next(improved(epochs, best_epoch), next_command)),
        _numbers(epochs, best_epoch),
        html.section("The course of the training", html.picture(curves, f"{caption}logarithmic.")),
        _shot(shot),
        html.section("What was learned of noise, spin and coefficients", html.table(head, rows)),
        html.section("Where this page comes from", html.table(("", ""), made)),
        html.section("What the words mean", html.meanings(TERMS)),
    )


def _next(better: bool | None, command: str) -> list[html.Html]:
    parts = []
    if better is False:
        lines = (
            "Lower optimizer.learning_rate by a factor of 3 to 10: errors that rise from the first epoch on mean steps "
            "that are too large.",
            "Train longer (optimizer.epochs) if the errors still fell at the end.",
            "Take more tracks if the error of the training tracks falls and that of the validation tracks rises.",
        )
        parts += [html.items(lines)]
    if command:
        parts += [html.tag("p", "Use the model that was written:"), html.tag("pre", html.typed(command))]
    return parts


def _numbers(epochs: Sequence[Epoch], best_epoch: int) -> html.Html:
    chosen = dict.fromkeys((epochs[0].epoch, best_epoch, epochs[-1].epoch))
    names = {epochs[-1].epoch: "last", best_epoch: "best, written", epochs[0].epoch: "before the first step"}
    by_number, rows = {e.epoch: e for e in epochs}, []
    for number in (n for n in chosen if n in by_number):
        one = by_number[number]
        errors = ["–" if rmse is None else f"{1e3 * rmse:.1f} mm" for rmse in (one.train_rmse, one.validation_rmse)]
        rows.append((f"{number}: {names[number]}", *errors, "–" if one.loss is None else f"{one.loss:.4g}"))
    head = (
        html.explained("epoch", TERMS["epoch"]),
        html.explained("RMSE, training tracks", TERMS["RMSE"]),
        html.explained("RMSE, validation tracks", TERMS["validation"]),
        html.explained("loss", TERMS["loss"]),
    )
    return html.section("How good the model is", html.table(head, rows))


def _shot(shot: PredictedShot | None) -> html.Html:
    if shot is None:
        return html.Html()
    ahead = shot.times > 0.0
    error = np.linalg.norm(shot.predicted - shot.measured, axis=-1)
    off = 1e3 * float(np.sqrt((error[ahead] ** 2).mean())) if ahead.any() else float("nan")
    seen = int((~ahead).sum())
    observed = (
        f"Crosses mark the {seen} samples that the estimate observed, circles the {int(ahead.sum())} that it had to "
        "predict; the dashed line stands between them."
        if seen
        else f"Circles mark the {len(ahead)} samples that it had to predict; those that it observed are not drawn."
    )
    caption = (
        f"Validation track {shot.name}, whose error is the median: the prediction is off by {off:.1f} mm (RMSE). "
        f"{observed}"
    )
    return html.section("Predicted against measured", html.picture(_drawn(shot, error), caption))


def _drawn(shot: PredictedShot, error: Array) -> Figure:
    figure = Figure(figsize=(7.4, 8.0), layout="constrained")
    panels = figure.subplots(4, 1, sharex=True)
    for i, axes in enumerate(panels[:3]):
        ahead = shot.times > 0.0
        for part, marker, label in ((~ahead, "x", "measured, observed"), (ahead, "o", "measured")):
            if part.any():
                where, place = shot.times[part], shot.measured[part, i]
                axes.plot(where, place, marker, color=MEASURED, markersize=4, fillstyle="none", label=label)
        axes.plot(shot.times, shot.predicted[:, i], "-", color=PREDICTED, label="model")
        axes.set_ylabel(f"{'xyz'[i]}, m")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=3, fontsize="small")
    panels[3].plot(shot.times, 1e3 * error, ".-", color=PREDICTED)
    panels[3].set(ylabel="error, mm", xlabel="time since the last observed sample, s", ylim=(0.0, None))
    for axes in panels:
        axes.axvline(0.0, color="black", linestyle="--", linewidth=0.8)
        axes.grid(visible=True, alpha=0.25)
    return figure
