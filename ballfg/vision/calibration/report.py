"""What a calibration found, in lines for people and as a mapping for programs."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from ballfg.vision.calibration.extrinsics import Extrinsics
from ballfg.vision.calibration.intrinsics import RAYS, FittedView, Intrinsics
from ballfg.vision.camera import Camera

COEFFICIENTS: Final = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")
"""Names of OpenCV's distortion coefficients, in their order."""
IN_A_LINE: Final = 6
"""Views that a line of the summary names."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """What was found about one camera."""

    camera: Camera

    lens: Intrinsics | None
    """None where the lens was known before."""

    place: Extrinsics | None
    """None where the camera's place was not asked for."""


def summary(found: Calibration) -> Iterator[str]:
    """Lines that say how well the camera is known."""
    width, height = found.camera.size
    yield f"{found.camera.name}: {width}x{height}"
    if found.lens is not None:
        yield from _lens_lines(found.lens)
    if found.place is not None:
        yield from _place_lines(found.place)


def _lens_lines(lens: Intrinsics) -> Iterator[str]:
    count = len(lens.views) + len(lens.left_out) + len(lens.missed)
    yield f"  lens: {len(lens.views)} of {count} images, RMS {lens.rms:.2f} px, corners in {lens.coverage:.0%} of cells"
    usual, worst = lens.ray_sigma
    yield f"    rays known to {usual:.2f} px in {RAYS:.0%} of the image, {worst:.2f} px where worst"
    values, sigmas = _lens_numbers(lens)
    yield (
        "    "
        + ", ".join(f"{name} {values[name]:.1f} ± {sigmas[name]:.1f}" for name in ("fx", "fy", "cx", "cy"))
        + " px"
    )
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


def _place_lines(place: Extrinsics) -> Iterator[str]:
    x, y, z = place.camera.centre
    yield f"  place: {len(place.marked.names)} points, RMS {place.rms:.2f} px"
    yield (
        f"    at ({x:.3f}, {y:.3f}, {z:.3f}) m ± {1e3 * place.centre_sigma:.1f} mm, "
        f"turned ± {np.degrees(place.turn_sigma):.3f} degrees"
    )
    errors = np.linalg.norm(place.residuals, axis=1)
    yield "    px: " + ", ".join(f"{name} {error:.2f}" for name, error in zip(place.marked.names, errors, strict=True))


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
            "views": [_view(fitted) for fitted in lens.views],
            "left_out": [_view(fitted) for fitted in lens.left_out],
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
    return result


def _view(fitted: FittedView) -> dict[str, Any]:
    return {"image": fitted.view.name, "corners": len(fitted.view.pixels), "rms": fitted.rms}


def _lens_numbers(lens: Intrinsics) -> tuple[dict[str, float], dict[str, float]]:
    """Values and standard deviations by name."""
    matrix, bent = lens.camera.matrix, lens.camera.distortion
    names = ("fx", "fy", "cx", "cy", *COEFFICIENTS[: len(bent)])
    values = [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *bent]
    return dict(zip(names, map(float, values), strict=True)), dict(zip(names, map(float, lens.sigmas), strict=True))
