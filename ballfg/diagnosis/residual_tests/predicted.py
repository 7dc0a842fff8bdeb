"""Tests the noise of a corrected model on the other half of the tracks.

All other tests look at the fit of the search half. Where the halves differ, as with two balls thrown in turn, or where
predictions see something else than the fit, that fit is good and predictions are not.
"""

import math
from dataclasses import replace
from typing import Final

from ballfg.diagnosis.generic_test import PREDICTED, GenericTest
from ballfg.diagnosis.result import Errors
from ballfg.diagnosis.search.process_noise import MOST_FOR_NOISE

NONE: Final = GenericTest(
    PREDICTED, f"{PREDICTED}: errors of the held-out tracks are not larger than the model's noise expects", 1.0, 0.0
)


def predicted_test(before: Errors, after: Errors, fitted: int) -> GenericTest:
    """The test for squared errors beyond those that a model with its noise expects, by the scatter between tracks.

    Args:
        before, after: errors of the declared and of the corrected model on the held-out half.
        fitted: number of tracks of the search half. The noise is known as well as so many tracks tell it.
    Returns: the test; its share is that of the declared model's squared error beyond the corrected model's noise.
    """
    judged, told = len(after.by_track), min(fitted, MOST_FOR_NOISE)
    excess, sigma = after.nis - 1.0, after.nis_error * math.sqrt(1.0 + judged / told)
    if not (excess > 0.0 and sigma > 0.0 and judged > 1 and told > 1):
        return NONE
    from scipy import stats  # it takes half a second to import

    p_value = float(stats.t.sf(excess / sigma, min(judged, told) - 1))
    left = after.prediction_rmse_mm**2 * excess / after.nis
    whole = max(left, before.prediction_rmse_mm**2 - after.prediction_rmse_mm**2 + left)
    times = math.sqrt(after.nis)
    where = f"{PREDICTED}: errors of the held-out tracks are {times:.2g} times those that the model's noise expects"
    return replace(NONE, where=where, p_value=p_value, share=left / whole)
