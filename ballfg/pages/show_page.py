"""Builds the page of `ballfg show`: its sentence, its parts, and the data for its script."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from ballfg.arrays import Array
from ballfg.pages.html import Html, doubtful, explained, items, own, section, table, tag, whole_page
from ballfg.pages.shot import FLIGHT, HALF_WIDTH, LEVEL, ShownShot
from ballfg.pages.shown import NET_HEIGHT, Outline, Shown
from ballfg.pages.sight import near_picture
from ballfg.state import POSITION, SPIN, VELOCITY

LENGTH_DECIMALS, TIME_DECIMALS, VELOCITY_DECIMALS, SPIN_DECIMALS = 5, 5, 3, 1
"""Digits after the point of m, s, m/s and rad/s in the page: 10 um is far below what trackers resolve."""
SIGMA_DECIMALS = 6  # Digits of standard deviations in m: those of a state may be a tenth of a mm
CORRELATION_DECIMALS = 6  # The depth of a ray is at most a thousand times less sure than its direction
LARGEST = 8.0
"""Standard deviations beyond which a residual is drawn at the edge, so that an outlier does not hide the others."""
CANDIDATES = 10  # Number of effects of a diagnosis in the drawing, those that explain most


def show_page(shown: Shown) -> str:
    """The whole page, self-contained. Args: shown: result of `collect`."""
    name = _name(shown)
    doubts = doubtful(() if shown.given.dataset is None else shown.given.dataset.info.doubts)
    header = tag("header", tag("p", name), tag("h1", _sentence(shown)), doubts, items(shown.notes))
    of_shots = [_flight(shown), _measured_and_predicted(shown), _residuals(shown)] if shown.shots else []
    parts = [*of_shots, _coverage(shown), _diagnosis(shown)]
    return whole_page(
        f"{name}: shots",
        header,
        *parts,
        style=own("show.css"),
        data=_data(shown),
        scripts=(own("show.js"),),
        plotly=True,
    )


def _name(shown: Shown) -> str:
    given = shown.given
    if given.dataset is not None:
        return given.dataset.info.name
    if given.diagnosis is not None:
        return str(given.diagnosis.get("dataset", "diagnosis"))
    return next(one.path.name for one in (given.states, given.predictions) if one is not None)


def _sentence(shown: Shown) -> str:
    given, count = shown.given, len(shown.shots)
    if not count:
        return "The diagnosis of a model."
    what = [
        f"{sum(len(shot.times) for shot in shown.shots)} measured samples" if given.dataset is not None else "",
        f"the estimate of {given.states.path.name}" if given.states is not None else "",
        f"the predictions of {given.predictions.path.name}" if given.predictions is not None else "",
        "a diagnosis of the model" if given.diagnosis is not None else "",
    ]
    words = [word for word in what if word]
    listed = words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
    shots = "One shot" if count == shown.count == 1 else f"{count} shots"
    if count < shown.count:
        shots = f"{count} of {shown.count} shots (--track chooses others)"
    return f"{shots}: {listed}."


def _flight(shown: Shown) -> Html:
    options = [tag("option", shot.name) for shot in shown.shots]
    scales = [tag("option", f"×{n}", value=str(n)) for n in (1, 3, 10)]
    speeds = [
        tag("option", words, value=value) for words, value in (("a quarter", "0.25"), ("a tenth", "0.1"), ("real", "1"))
    ]
    cameras = [tag("option", word) for word in _camera_choices(shown)]
    choice = tag(
        "div",
        tag("label", "Shot ", tag("select", *options, id="shot")),
        tag("label", "Tube ", tag("select", *scales, id="scale")),
        tag("label", "Speed ", tag("select", *speeds, id="speed")),
        tag("label", "Cameras ", tag("select", *cameras, id="cameras")) if cameras else "",
        kind="controls",
    )
    moment = Html('<input type="range" id="moment" min="0" max="0" step="1" value="0" aria-label="time">')
    time = tag("label", "Time ", moment, kind="time")
    running = tag("div", tag("button", "Play", type="button", id="play"), time, kind="controls")
    words = (
        "Turn the picture with the mouse or a finger. Times count from the shot's first stamp. A tube holds "
        "the central 90 % of each direction across the flight. What lies far from samples, estimate and table is "
        "cut off."
    )
    if shown.given.states is not None and shown.given.dataset is not None:
        words += " Contacts and hits are read off the states: where the ball turns up at a surface, and where it jumps."
    if any((shot.labels != FLIGHT).any() for shot in shown.shots):
        words += " Where the ball is held, rolls, rests or is lost the samples are drawn as measured, in other colours."
    space = _figure("space", "In space", words, "plot space")
    return section("The shot", choice, running, tag("p", "", kind="readout quiet", id="readout"), space)


def _camera_choices(shown: Shown) -> list[str]:
    """Whether cameras and rays are shown, the default first: those of one camera show where depth is not known."""
    seen = [shot.sight for shot in shown.shots if shot.sight is not None]
    return sorted(("hidden", "shown"), reverse=all(one.one_view for one in seen)) if seen else []


def _measured_and_predicted(shown: Shown) -> Html:
    words = "The bands hold 90 %: of the ball's place for an estimate, of a measurement for a prediction."
    figures = [_figure("axes", "Position by axis", words, "plot tall")]
    if shown.given.predictions is not None and shown.given.dataset is not None:
        words = "Nine of ten samples belong inside the band."
        figures.append(_figure("errors", "Measured less predicted, by axis", words, "plot tall"))
    return section("Position by time", tag("div", *figures, kind="plots"))


def _residuals(shown: Shown) -> Html:
    if shown.given.states is None or shown.given.dataset is None:
        return Html()
    meaning = "The measured position less the estimated one. A pattern in time is something that the model lacks."
    figures = [_figure("residuals", "In mm", "Along x, y and z.", "plot")]
    if shown.noise:
        words = (
            "Divided by the standard deviation of a sample. Nine of ten, or a few more since the estimate follows the "
            f"samples, belong between the dashed lines. Those beyond {LARGEST:g} are drawn there, with open signs."
        )
        figures.append(_figure("whitened", "In standard deviations", words, "plot"))
    words_ = tag("p", "The ", explained("residuals", meaning), " where the estimate moves a sample. ", shown.noise)
    return section("Residuals: measured less estimated", words_, tag("div", *figures, kind="plots"))


def _coverage(shown: Shown) -> Html:
    if shown.coverage is None:
        return Html()
    if not len(shown.coverage.horizons):
        return section("Coverage of the predictions", tag("p", "No shot has samples before its first prediction."))
    words = tag(
        "p",
        "The share of measured coordinates inside their 90 % intervals, by ",
        explained("horizon", "Time from the last observed sample to the predicted one."),
        ", over all predicted shots. It belongs at the dashed line: "
        "below it the intervals are too narrow, above it too wide.",
    )
    return section("Coverage of the predictions", words, _figure("coverage", "90 % intervals", "", "plot"))


def _diagnosis(shown: Shown) -> Html:
    found = shown.given.diagnosis
    if found is None:
        return Html()
    error = found["error"]
    rows = [
        (words, _number(error["before"].get(key)), _number(error["after"].get(key)))
        for words, key in (
            ("prediction error, mm", "prediction_rmse_mm"),
            ("error of the apex, mm", "apex_rmse_mm"),
            ("mean squared error in standard deviations (1 is right)", "nis"),
            ("share inside 90 % intervals", "intervals_held"),
        )
    ]
    added = [tag("span", tag("b", str(one["name"])), f": {one['sentence']}") for one in found.get("effects", ())]
    values = [
        (
            tag("code", name),
            _number(value.get("declared")),
            f"{_number(value['value'])} ± {_number(value['sigma'])}",
            value["unit"],
        )
        for name, value in found["calibrated"].items()
    ]
    words = "Each dot is a track that was held out of the search: its first 40 % observed, the rest predicted."
    figures = [_figure("tracks", "Prediction error of held-out tracks", words, "plot")]
    if _candidates(found):
        words = "Candidates of the first round, those that explain most."
        figures.append(_figure("candidates", "Effects that were tested", words, "plot"))
    return section(
        "Diagnosis of the model",
        tag("p", tag("b", str(found["verdict"])), f": {found['sentence']}"),
        items(added),
        tag("div", *figures, kind="plots"),
        table(("on the held-out tracks", "before", "after"), rows),
        table(("coefficient", "declared", "fitted", "unit"), values),
    )


def _figure(name: str, title: str, caption: str, kind: str) -> Html:
    below = tag("figcaption", caption) if caption else ""
    return tag("figure", tag("h3", title), tag("div", kind=kind, id=name), below)


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.4g}"


def _data(shown: Shown) -> dict[str, Any]:
    """The data for the script; null stands for unknown numbers."""
    held, found, diagnosis = shown.coverage, shown.given.diagnosis, None
    if found is not None:  # `after` only if the model was changed, and the first round's candidates
        before, after = (found["error"][which].get("by_track_mm", []) for which in ("before", "after"))
        changed = None if after == before else after
        diagnosis = {"before": before, "after": changed, "candidates": _candidates(found)}
    return {
        "half_width": HALF_WIDTH,
        "level": 100.0 * LEVEL,
        "largest": LARGEST,
        "table": None if shown.table is None else _table(shown.table),
        "cameras": _cameras(shown),
        "shots": [_shot(shot) for shot in shown.shots],
        "coverage": None
        if held is None or not len(held.horizons)
        else {
            "horizons": _plain(held.horizons, TIME_DECIMALS),
            "shares": _plain(held.shares, TIME_DECIMALS),
            "samples": held.samples.tolist(),
            "shots": held.shots.tolist(),
        },
        "diagnosis": diagnosis,
    }


def _table(outline: Outline) -> dict[str, Any]:
    """The table with the corners of its net, which stands across the longer side."""
    x0, x1, y0, y1 = outline.extent
    bottom, top = outline.height, outline.height + NET_HEIGHT
    net = None
    if outline.net and x1 - x0 >= y1 - y0:
        x, low, high = 0.5 * (x0 + x1), y0 - NET_HEIGHT, y1 + NET_HEIGHT
        net = [[x, low, bottom], [x, high, bottom], [x, high, top], [x, low, top]]
    elif outline.net:
        y, low, high = 0.5 * (y0 + y1), x0 - NET_HEIGHT, x1 + NET_HEIGHT
        net = [[low, y, bottom], [high, y, bottom], [high, y, top], [low, y, top]]
    return {"height": outline.height, "extent": list(outline.extent), "net": net, "floor": outline.floor}


def _cameras(shown: Shown) -> list[dict[str, Any]]:
    """Each camera with its place and the corners of its picture."""
    seen = [shot.sight for shot in shown.shots if shot.sight is not None]
    found = {camera.name: camera for one in seen for camera in one.cameras}
    return [
        {
            "name": name,
            "place": _plain(camera.centre, LENGTH_DECIMALS),
            "corners": _plain(near_picture(camera), LENGTH_DECIMALS),
        }
        for name, camera in found.items()
    ]


def _rays(shot: ShownShot) -> list[dict[str, Any]]:
    """Rays of each camera that saw the ball, `from` and `to` (3, k) m."""
    found = {} if shot.sight is None else shot.sight.some(shot.positions)
    ends = {name: [_plain(places.T, LENGTH_DECIMALS) for places in both] for name, both in found.items()}
    return [{"camera": name, "from": begin, "to": end} for name, (begin, end) in ends.items()]


def _shot(shot: ShownShot) -> dict[str, Any]:
    start = shot.start
    states = [
        *_plain(shot.states[:, POSITION].T, LENGTH_DECIMALS),
        *_plain(shot.states[:, VELOCITY].T, VELOCITY_DECIMALS),
        *_plain(shot.states[:, SPIN].T, SPIN_DECIMALS),
    ]
    known = len(shot.state_times) > 0
    noise = _plain(shot.noise.T, SIGMA_DECIMALS) if known else []  # of each axis one number if all are equal
    return {
        "name": shot.name,
        "gap": shot.gap,
        "t": _plain(shot.times - start, TIME_DECIMALS),
        "positions": _plain(shot.positions.T, LENGTH_DECIMALS),
        "noise": [row[0] if len(set(row)) == 1 else row for row in noise],
        "residuals": _plain(shot.residuals().T, LENGTH_DECIMALS) if known else [],
        "state_t": _plain(shot.state_times - start, TIME_DECIMALS),
        "states": states,
        "labels": shot.labels.tolist() if (shot.labels != FLIGHT).any() else [],
        "state_sigmas": _plain(shot.state_sigmas[:, :3].T, SIGMA_DECIMALS),
        "correlations": _plain(shot.correlations.T, CORRELATION_DECIMALS) if shot.correlations.any() else [],
        "rays": _rays(shot),
        "predicted_t": _plain(shot.predicted_times - start, TIME_DECIMALS),
        "predicted": _plain(shot.predicted.T, LENGTH_DECIMALS),
        "predicted_sigmas": _plain(shot.predicted_sigmas.T, SIGMA_DECIMALS),
        "prediction_errors": _plain(shot.prediction_errors().T, LENGTH_DECIMALS),
        "marks": [{"kind": mark.kind, "t": mark.time - start, "place": list(mark.place)} for mark in shot.marks],
    }


def _candidates(found: Mapping[str, Any]) -> list[dict[str, Any]]:
    rounds = found["rounds"]
    rows = [row for row in rounds[0] if (row.get("explained") or 0.0) > 0.0] if rounds else []
    rows.sort(key=lambda row: -float(row["explained"]))
    return [{"name": r["name"], "explained": r["explained"], "outcome": r["standing"]} for r in rows[:CANDIDATES]]


def _plain(array: Array, decimals: int) -> list[Any]:
    """Nested lists of rounded numbers, None for numbers that are not finite."""
    rounded = np.round(array, decimals).astype(object)
    rounded[~np.isfinite(array)] = None
    plain: list[Any] = rounded.tolist()
    return plain
