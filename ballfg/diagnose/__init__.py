"""Find what a model lacks: residuals, candidate effects, tests, the loop and its report."""

from ballfg.diagnose.diagnosis import diagnose
from ballfg.diagnose.report import write_report
from ballfg.diagnose.result import Diagnosis, Finding, Verdict

__all__ = ["Diagnosis", "Finding", "Verdict", "diagnose", "write_report"]
