"""Synthetic recordings: the simulator's balls, filmed by cameras over a table, with the truth beside the videos."""

from ballfg.simulate.scene.config import Clock, SceneConfig
from ballfg.simulate.scene.flights import Flight, fly_shots
from ballfg.simulate.scene.recording import Recording, record
from ballfg.simulate.scene.renderer import Renderer
from ballfg.simulate.scene.shutter import Frames, Passage, free_running
from ballfg.simulate.scene.writing import write_scene

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
