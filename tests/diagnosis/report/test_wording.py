"""The answer of a diagnosis in words."""

from dataclasses import replace

import pytest

from ballfg.diagnosis.report.wording import odds, sentence
from ballfg.diagnosis.result import Unexplained, Value, Verdict
from tests.diagnosis.made_diagnosis import found

WIND = replace(found().findings[0], indistinguishable_from=())
JITTER = replace(WIND, name="stamp_jitter", parameters={"sigma": Value(0.0004, 0.00001, "s")})
LEFT = Unexplained("flight: off everywhere", 0.4, (), None)
SHOWN = "The measurements show stamp_jitter (sigma 0.000400 ± 0.000010 s)"


@pytest.mark.parametrize(
    ("verdict", "findings", "begins", "ends"),
    [
        (Verdict.NOTHING, [], "Nothing is lacking", "is noise."),
        (Verdict.FOUND, [WIND], "The model lacks wind (", "with it what is left is noise."),
        (Verdict.FOUND, [WIND, JITTER], "The model lacks wind (", f"with it what is left is noise. {SHOWN}."),
        (Verdict.FOUND, [JITTER], f"{SHOWN}; no effect is lacking", "what is left is noise."),
        (Verdict.UNEXPLAINED, [], "Something is lacking that no effect", "flight: off everywhere."),
        (Verdict.UNEXPLAINED, [JITTER], "Something is lacking that no effect", f"{SHOWN}."),
        (Verdict.UNEXPLAINED, [WIND, JITTER], "Something is lacking: wind (", f"flight: off everywhere. {SHOWN}."),
    ],
)
def test_a_tracker_is_not_what_a_model_lacks(verdict, findings, begins, ends) -> None:
    said = sentence(verdict, findings, LEFT)
    assert said.startswith(begins)
    assert said.endswith(ends)


def test_no_probability_is_certain() -> None:
    assert [odds(p) for p in (1.0, 0.998, 0.5, 0.002, 0.0)] == ["> 99.9 %", "99.8 %", "50.0 %", "0.2 %", "< 0.1 %"]
