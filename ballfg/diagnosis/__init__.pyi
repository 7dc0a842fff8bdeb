from .diagnosis import diagnose as diagnose
from .report.report import write_report as write_report
from .result import Diagnosis as Diagnosis
from .result import Finding as Finding
from .result import Verdict as Verdict
