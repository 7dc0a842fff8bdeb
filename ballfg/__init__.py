"""ballfg turns noisy measurements of a flying, bouncing ball into states, predictions and knowledge.

A first estimate::

    import ballfg as bf

    shots = bf.read("my_shots")  # a folder of tracks: docs/tracks.md; one track: bf.Track(times, positions)
    estimate = bf.estimate(shots["001"])  # the smoother, with the dataset's ball, table and noise
    ahead = bf.predict(estimate, horizon=0.3)  # where the ball will be, with standard deviations
    found = bf.diagnose(shots)  # the effects that the model of the ball lacks

Further names lie one room down, such as `ballfg.vision.read_cameras`; docs/map.md shows the rooms. A module is imported
when one of its names is first used.
"""

import lazy_loader

_name, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> object:
    if name == "__version__":
        from importlib.metadata import version

        return version("ballfg")
    return _name(name)
