"""Reports a calibration as lines and a picture for people, and as a mapping for programs."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from ballfg.checks import drawn
from ballfg.vision.arrays import Image
from ballfg.vision.calibration.extrinsics import Extrinsics
from ballfg.vision.calibration.intrinsics import CELLS, RAYS, USUAL_VIEWS, Intrinsics
from ballfg.vision.calibration.table_points import TABLE_HEIGHT, table_outline
from ballfg.vision.camera import Camera

COEFFICIENTS: Final = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")
"""Names of OpenCV's distortion coefficients, in their order."""
BLUE, VERMILION, GREY = "#0072b2", "#d55e00", "#8c8c8c"
OUTLINED: Final = withStroke(linewidth=1.5, foreground="white")  # for letters that must be read over any image
ARROW: Final = 0.05  # length of a residual of three times the median in the drawing, as a share of the image's width
PARTS: Final = 40  # number of parts of a drawn line, which the lens bends
PANEL: Final = (5.0, 3.4)  # inches, width and height of a panel
DPI: Final = 120
UNLIKELY: Final = 1e-3  # chance of the residuals at table points below which the lens or a point is probably wrong
IN_A_LINE: Final = 6  # views that a line of the summary names


@dataclass(frozen=True, eq=False)
class Calibration:
    """The calibration of one camera."""

    camera: Camera

    lens: Intrinsics | None  # None if the lens was known before
    place: Extrinsics | None  # None if the camera's pose was not calibrated


def summary(found: Calibration) -> Iterator[str]:
    """Lines on the accuracy of the camera's calibration."""
    width, height = found.camera.size
    yield f"{found.camera.name}: {width}x{height}"
    if found.lens is not None:
        yield from _lens_lines(found.lens)
    if (place := found.place) is not None:
        x, y, z = place.camera.centre
        errors = zip(place.marked.names, np.linalg.norm(place.residuals, axis=1), strict=True)
        yield f"  place: {len(place.marked.names)} points, RMS {place.rms:.2f} px"
        if place.chance < UNLIKELY:
            chance = f"noise of {place.marked.sigma:g} px explains that with a chance of {place.chance:.0e}"
            found_too = place.camera.covariance is not None
            further = "" if found_too else ", or find the focal length too, with --focal-sigma 0.05"
            yield f"    note: {chance}. Check names and pixels{further}."
        yield (
            f"    at ({x:.3f}, {y:.3f}, {z:.3f}) m ± {1e3 * place.centre_sigma:.1f} mm, "
            f"turned ± {np.degrees(place.turn_sigma):.3f} degrees"
        )
        if (covariance := place.camera.covariance) is not None:
            yield f"    focal length {place.camera.matrix[0, 0]:.1f} px ± {np.sqrt(covariance[-1, -1]):.1%}"
        yield "    px: " + ", ".join(f"{name} {error:.2f}" for name, error in errors)


def _lens_lines(lens: Intrinsics) -> Iterator[str]:
    count = len(lens.views) + len(lens.left_out) + len(lens.missed)
    yield f"  lens: {len(lens.views)} of {count} images, RMS {lens.rms:.2f} px, corners in {lens.coverage:.0%} of cells"
    if len(lens.views) < USUAL_VIEWS:
        yield (
            "    few images: the uncertainties hold if the board is flat and all corners are right, which "
            f"{USUAL_VIEWS} or more images show"
        )
    usual, worst = lens.ray_sigma
    yield f"    rays known to {usual:.2f} px in {RAYS:.0%} of the image, {worst:.2f} px where worst"
    values, sigmas = _lens_numbers(lens)
    pinhole = ", ".join(f"{name} {values[name]:.1f} ± {sigmas[name]:.1f}" for name in ("fx", "fy", "cx", "cy"))
    yield f"    {pinhole} px"
    bent = [name for name in values if name in COEFFICIENTS]
    if bent:
        yield "    " + ", ".join(f"{name} {values[name]:.4f} ± {sigmas[name]:.4f}" for name in bent)
    errors = [f"{fitted.view.name} {fitted.rms:.2f}" for fitted in lens.views]
    for first in range(0, len(errors), IN_A_LINE):
        yield f"    {'px RMS:' if first == 0 else '       '} {', '.join(errors[first : first + IN_A_LINE])}"
    if lens.left_out:
        names = ", ".join(f"{fitted.view.name} {fitted.rms:.2f}" for fitted in lens.left_out)
        yield f"    left out, they disagree with the others: {names}"
    if lens.missed:
        yield f"    no board, or hardly any of it, in: {', '.join(lens.missed)}"


def content(found: Calibration) -> dict[str, Any]:
    """The same as plain numbers and text, in px, m and degrees."""
    result: dict[str, Any] = {"camera": found.camera.name, "size": list(found.camera.size)}
    if found.lens is not None:
        lens = found.lens
        values, sigmas = _lens_numbers(lens)
        result["lens"] = {
            "rms": lens.rms,
            "coverage": lens.coverage,
            "ray_sigma": lens.ray_sigma[0],
            "worst_ray_sigma": lens.ray_sigma[1],
            "values": values,
            "sigmas": sigmas,
            **{
                kind: [{"image": v.view.name, "corners": len(v.view.pixels), "rms": v.rms} for v in getattr(lens, kind)]
                for kind in ("views", "left_out")
            },
            "missed": list(lens.missed),
        }
    if found.place is not None:
        place = found.place
        errors = dict(zip(place.marked.names, place.residuals.tolist(), strict=True))
        result["place"] = {
            "rms": place.rms,
            "centre": place.camera.centre.tolist(),
            "centre_sigma": place.centre_sigma,
            "turn_sigma": float(np.degrees(place.turn_sigma)),
            "residuals": errors,
        }
        if place.camera.covariance is not None:
            result["place"]["focal"] = float(place.camera.matrix[0, 0])
            result["place"]["focal_sigma"] = float(place.camera.matrix[0, 0] * np.sqrt(place.camera.covariance[-1, -1]))
    return result


def _lens_numbers(lens: Intrinsics) -> tuple[dict[str, float], dict[str, float]]:
    matrix, bent = lens.camera.matrix, lens.camera.distortion
    names = ("fx", "fy", "cx", "cy", *COEFFICIENTS[: len(bent)])
    values = [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *bent]
    return dict(zip(names, map(float, values), strict=True)), dict(zip(names, map(float, lens.sigmas), strict=True))


def calibration_picture(
    found: Sequence[Calibration], images: Mapping[str, Image], table_height: float = TABLE_HEIGHT
) -> Figure:
    """One row a camera: residuals of the corners, error of each view, the table in the image.

    Args: images: by the camera's name, grey, what the table's outline is drawn into; white without one.
        table_height: m, z of the table's surface.
    """
    kinds: list[tuple[str, Callable[[Axes, Any], None]]] = []
    if any(one.lens is not None for one in found):
        kinds += [("lens", _corners), ("lens", _views)]
    if any(one.place is not None for one in found):
        kinds.append(("place", lambda axes, one: _table(axes, one, images.get(one.camera.name), table_height)))
    width, height = PANEL
    figure = Figure(figsize=(width * len(kinds), height * len(found) + 0.3), dpi=DPI, layout="constrained")
    panels = figure.subplots(len(found), len(kinds), squeeze=False)
    for row, one in zip(panels, found, strict=True):
        for axes, (part, draw) in zip(row, kinds, strict=True):
            if (given := getattr(one, part)) is None:
                axes.set_axis_off()
            else:
                draw(axes, given)
    return figure


def _corners(axes: Axes, lens: Intrinsics) -> None:
    pixels = np.concatenate([fitted.view.pixels for fitted in lens.views])
    residuals = np.concatenate([fitted.residuals for fitted in lens.views])
    _image_axes(axes, lens.camera)
    width, height = lens.camera.size
    for side, count, line in ((width, CELLS[0], axes.axvline), (height, CELLS[1], axes.axhline)):
        for place in np.linspace(0, side, count + 1)[1:-1]:
            line(place - 0.5, color=GREY, linewidth=0.3)
    typical = float(np.median(np.linalg.norm(residuals, axis=1)))
    longer = ARROW * width / (3.0 * typical) if typical > 0.0 else 1.0
    axes.quiver(*pixels.T, *(longer * residuals).T, angles="xy", scale_units="xy", scale=1, width=0.002, color=BLUE)
    axes.set_title(
        f"{drawn(lens.camera.name)}: corners as seen minus as projected, x{longer:.0f}\n"
        f"RMS {lens.rms:.2f} px; corners in {lens.coverage:.0%} of the cells",
        size=9,
    )


def _views(axes: Axes, lens: Intrinsics) -> None:
    fitted = [*lens.views, *lens.left_out]
    colours = [BLUE] * len(lens.views) + [VERMILION] * len(lens.left_out)
    places = np.arange(len(fitted))
    axes.bar(places, [one.rms for one in fitted], color=colours)
    axes.axhline(lens.rms, color=GREY, linewidth=0.8)
    if lens.left_out:  # a wrong view is worse by so much that the others could not be seen beside it
        axes.set_yscale("log")
    axes.set_xticks(places, [drawn(one.view.name) for one in fitted], rotation=90, size=6)
    axes.set_ylabel("RMS, px")
    orange = "; orange: left out" if lens.left_out else ""
    axes.set_title(f"{drawn(lens.camera.name)}: error of each view{orange}", size=9)


def _table(axes: Axes, place: Extrinsics, image: Image | None, table_height: float) -> None:
    if image is not None:
        axes.imshow(image, cmap="gray", vmin=0, vmax=255)
    _image_axes(axes, place.camera)
    share = np.linspace(0.0, 1.0, PARTS + 1)[:, None]
    for start, end in table_outline(table_height):
        points = (1.0 - share) * start + share * end
        seen = place.camera.in_view(points)[:, None]  # outside the image distortion means nothing
        axes.plot(*np.where(seen, place.camera.project(points), np.nan).T, color=VERMILION, linewidth=1.0)
    axes.plot(*place.marked.pixels.T, "o", color=BLUE, markersize=6, fillstyle="none")
    for name, pixel in zip(place.marked.names, place.marked.pixels, strict=True):
        axes.annotate(name, pixel, (4, 4), textcoords="offset points", size=6, color=BLUE, path_effects=[OUTLINED])
    axes.set_title(
        f"{drawn(place.camera.name)}: the table as projected; circles: as marked\n"
        f"RMS {place.rms:.2f} px; camera ± {1e3 * place.centre_sigma:.1f} mm, ± {np.degrees(place.turn_sigma):.2f}°",
        size=9,
    )


def _image_axes(axes: Axes, camera: Camera) -> None:
    width, height = camera.size
    limits = {"xlim": (-0.5, width - 0.5), "ylim": (height - 0.5, -0.5)}
    axes.set(**limits, aspect="equal", xlabel="u, px", ylabel="v, px")
