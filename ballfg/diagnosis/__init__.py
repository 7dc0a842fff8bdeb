"""Find what a model lacks: residuals, candidate effects, tests, the loop and its report."""

from ballfg.diagnosis.diagnosis import diagnose
from ballfg.diagnosis.report.report import write_report
from ballfg.diagnosis.result import Diagnosis, Finding, Verdict

__all__ = ["Diagnosis", "Finding", "Verdict", "diagnose", "write_report"]
