"""Find effects that a model of the ball lacks.

`diagnose` does the whole diagnosis and `write_report` writes its result. The other functions are single steps of it.
"""

from ballfg.diagnosis.diagnosis import diagnose
from ballfg.diagnosis.fit.fit import fit_model
from ballfg.diagnosis.fit.holdout import hold_out
from ballfg.diagnosis.remains.fallback import learned_residual
from ballfg.diagnosis.remains.generic import generic_tests
from ballfg.diagnosis.remains.residuals import residuals_of
from ballfg.diagnosis.remains.sparse import sparse_terms
from ballfg.diagnosis.report.report import write_report
from ballfg.diagnosis.result import Diagnosis, Finding, Verdict
from ballfg.diagnosis.search.candidates import refit, score_all
from ballfg.diagnosis.search.evaluation import held_out_gain, prediction_errors
from ballfg.diagnosis.search.hypothesis import hypotheses, scene_of

__all__ = [
    "Diagnosis",
    "Finding",
    "Verdict",
    "diagnose",
    "fit_model",
    "generic_tests",
    "held_out_gain",
    "hold_out",
    "hypotheses",
    "learned_residual",
    "prediction_errors",
    "refit",
    "residuals_of",
    "scene_of",
    "score_all",
    "sparse_terms",
    "write_report",
]
