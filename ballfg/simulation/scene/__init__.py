"""Synthetic recordings: the simulator's balls, filmed by cameras over a table, with the truth beside the videos."""

from ballfg.simulation.scene.config import Clock, SceneConfig
from ballfg.simulation.scene.flights import Flight, fly_shots
from ballfg.simulation.scene.recording import Recording, record
from ballfg.simulation.scene.renderer import Renderer
from ballfg.simulation.scene.shutter import Frames, Passage, free_running
from ballfg.simulation.scene.writing import write_scene

__all__ = [
    "Clock",
    "Flight",
    "Frames",
    "Passage",
    "Recording",
    "Renderer",
    "SceneConfig",
    "fly_shots",
    "free_running",
    "record",
    "write_scene",
]
