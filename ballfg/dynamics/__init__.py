"""How a ball moves: the contract, physical effects, learned models, exact contacts, rollouts, model files."""

from ballfg.dynamics.analytic import AnalyticModel
from ballfg.dynamics.effect import BounceEffect, Coefficient, Effect, Flight, FlightEffect, Impact
from ballfg.dynamics.effects.registry import EFFECTS, load_effects, register
from ballfg.dynamics.model import BallModel, substitute
from ballfg.dynamics.model_file import load_model, model_from_dict, model_to_dict, save_model
from ballfg.dynamics.motion.contact import contact_time, fly_through, fly_through_jacobian
from ballfg.dynamics.motion.integrate import fly, fly_jacobian
from ballfg.dynamics.motion.rollout import advance, rollout
from ballfg.dynamics.networks.architecture import Architecture
from ballfg.dynamics.networks.learned import LearnedModel, build
from ballfg.dynamics.networks.spin_embedding import SpinEmbedding
from ballfg.dynamics.nominal import nominal_model, nominal_note
from ballfg.dynamics.surfaces import Surfaces
from ballfg.dynamics.trained import Trained

__all__ = [
    "EFFECTS",
    "AnalyticModel",
    "Architecture",
    "BallModel",
    "BounceEffect",
    "Coefficient",
    "Effect",
    "Flight",
    "FlightEffect",
    "Impact",
    "LearnedModel",
    "SpinEmbedding",
    "Surfaces",
    "Trained",
    "advance",
    "build",
    "contact_time",
    "fly",
    "fly_jacobian",
    "fly_through",
    "fly_through_jacobian",
    "load_effects",
    "load_model",
    "model_from_dict",
    "model_to_dict",
    "nominal_model",
    "nominal_note",
    "register",
    "rollout",
    "save_model",
    "substitute",
]
