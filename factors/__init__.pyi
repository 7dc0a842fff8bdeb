from .batch import (
    COEFFICIENTS as COEFFICIENTS,
    FactorBatch as FactorBatch,
    Noise as Noise,
    Rows as Rows,
    Values as Values,
)
from .bridge import Bridge as Bridge, from_gtsam as from_gtsam, nonlinear_graph as nonlinear_graph, to_gtsam as to_gtsam
from .check import check_factor as check_factor
from .dynamics import ContactFactors as ContactFactors, FlightFactors as FlightFactors
from .graph import BallGraph as BallGraph, LevenbergMarquardt as LevenbergMarquardt
from .noise import ProcessNoise as ProcessNoise
from .position import PositionFactors as PositionFactors
from .prior import spin_prior as spin_prior, state_prior as state_prior
