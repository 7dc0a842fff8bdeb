"""Draws the loop's benchmark: named against planted effects, and repaired errors."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import matplotlib.pyplot as plt
import numpy as np

from ballfg.benchmarks.diagnosis.cases import Case
from ballfg.benchmarks.diagnosis.record import Record
from ballfg.benchmarks.diagnosis.rows import ALL, of_part
from ballfg.benchmarks.pictures import BLUE, ORANGE, plain_ticks, save
from ballfg.benchmarks.results import Row

NOTHING: Final = "nothing"  # Column of the diagnoses that named no effect


def confusion_picture(cases: Sequence[Case], records: Mapping[str, Record], path: Path) -> Path:
    """First named effects (columns) for planted ones (rows), at typical size, with and without spin labels."""
    parts = [("naming", "spin labels"), ("no_labels", "no spin labels")]
    figure, panels = plt.subplots(1, 2, figsize=(15, 7.5), layout="constrained")
    for axes, (part, title) in zip(panels, parts, strict=True):
        chosen = [case for case in of_part(cases, part) if case.size == 1.0 and case.name in records]
        planted = list(dict.fromkeys(case.subject for case in chosen))
        found = [records[case.name].found for case in chosen]
        first = [findings[0].name if findings else NOTHING for findings in found]
        columns = [*planted, *sorted(set(first) - {*planted, NOTHING}), NOTHING]
        counts = np.zeros((len(planted), len(columns)))
        for case, name in zip(chosen, first, strict=True):
            counts[planted.index(case.subject), columns.index(name)] += 1
        shares = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
        axes.imshow(shares, cmap="Blues", vmin=0.0, vmax=1.0, aspect="auto")
        for (row, column), value in np.ndenumerate(shares):
            if value > 0.0:
                colour = "white" if value > 0.5 else "black"
                axes.text(column, row, f"{100 * value:.0f}", ha="center", va="center", size=7, color=colour)
        axes.set_xticks(range(len(columns)), columns, rotation=90, fontsize="small")
        axes.set_yticks(range(len(planted)), planted, fontsize="small")
        axes.set(xlabel="named first", ylabel="planted", title=f"{title}, {len(chosen)} datasets")
    return save(figure, path)


def repair_picture(rows: Sequence[Row], path: Path) -> Path:
    """Prediction error over that of the true model, by effect: with the declared and with the corrected model."""
    found = [row for row in rows if row.case == "repair" and row.metric != ALL]
    names = list(dict.fromkeys(row.metric for row in found))
    figure, axes = plt.subplots(figsize=(8, 0.3 * len(names) + 1.6), layout="constrained")
    for column, colour in (("before / true", ORANGE), ("after / true", BLUE)):
        own = [row for row in found if row.method == column]
        places = [names.index(row.metric) for row in own]
        ratios = np.array([(row.value, row.low, row.high) for row in own], dtype=np.float64).reshape(-1, 3)
        axes.hlines(places, ratios[:, 1], ratios[:, 2], color=colour, linewidth=1.2)
        axes.plot(ratios[:, 0], places, "o", color=colour, markersize=5, label=column)
    axes.axvline(1.0, color="black", linewidth=0.8)
    axes.set_yticks(range(len(names)), names, fontsize="small")
    axes.invert_yaxis()
    axes.set(xscale="log", xlabel="prediction RMSE on the judging half / that of the true model")
    plain_ticks(axes.xaxis)
    axes.set_title("What the diagnosis mends; dot: median over seeds, line: lowest to highest", size=11)
    axes.grid(visible=True, axis="x", which="both", alpha=0.25)
    figure.legend(loc="outside lower center", ncols=2, fontsize="small")
    return save(figure, path)
