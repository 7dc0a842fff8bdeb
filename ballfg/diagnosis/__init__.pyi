from .design.plan import design_shots as design_shots
from .diagnosis import diagnose as diagnose
from .evidence.weighed import weigh as weigh
from .fit.fit import fit_model as fit_model
from .fit.holdout import hold_out as hold_out
from .hypotheses.hypothesis import hypotheses as hypotheses, scene_of as scene_of
from .joint import JointDiagnosis as JointDiagnosis, diagnose_jointly as diagnose_jointly
from .report.report import write_report as write_report
from .residual_tests.generic import generic_tests as generic_tests
from .residual_tests.label_check import check_labels as check_labels
from .residual_tests.residuals import residuals_of as residuals_of
from .residual_tests.sparse import sparse_terms as sparse_terms
from .result import Diagnosis as Diagnosis
from .search.evaluation import prediction_errors as prediction_errors
from .search.refits import refit as refit
from .search.trial import score_all as score_all
