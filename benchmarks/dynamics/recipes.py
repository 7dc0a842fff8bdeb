"""How models are trained on measured tracks: few shots, real noise, launchers whose spin nobody measured.

The recipe was found on the shots to learn from, parted into folds. It is the same for all models in the factor graph;
they differ in `kind` and in what that implies.
"""

from __future__ import annotations

from typing import Any, Final

from ballfg.benchmarks.estimators.measured import HORIZON

RESIDUAL: Final = "analytic+mnn"
"""The method in which a network corrects the nominal model."""
OPTIMIZER: Final[dict[str, Any]] = {
    "learning_rate": 3e-3,
    "batch": 12,
    "epochs": 40,
    "clip": 5.0,
}
"""Of the models in the factor graph."""
ERROR_SCALE: Final = 0.03
"""m. Errors beyond it count linearly."""
LIKELIHOOD: Final = 0.002
"""Weight of the likelihood: little, to tie down the scale of the noise. At fifteen times the weight the launcher's spin
was learned to be known to 18 rad/s; the same model predicted training shots best at 4 to 8 rad/s."""
NOISE: Final = {"acceleration": 0.05, "spin_label": 6.0}
"""Where the noise starts; the spin as shots of one launcher setting scatter."""
ANCHOR: Final = 0.1
"""Weight of the distance from the nominal model where no track has been. On held-out shots of the same launchers it
makes no clear difference; it is there for other balls."""


def measured_content(method: str, common: dict[str, Any]) -> dict[str, Any]:
    """The config of a method in the factor graph.

    Args: method: its name in the comparison.  common: what does not depend on the tracks: kind, split, workers.
    """
    loss = {"horizon": HORIZON, "position_scale": ERROR_SCALE, "likelihood": LIKELIHOOD, "anchor": ANCHOR}
    content = common | {"optimizer": OPTIMIZER, "loss": loss, "noise": NOISE, "launcher": {"start": "tracks"}}
    return content | {"architecture": {"residual": True}} if method == RESIDUAL else content
