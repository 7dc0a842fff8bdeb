"""A window that can also go back, change its mind, let go of its oldest state, and start anew."""

from __future__ import annotations

import gtsam

from ballfg.estimate.online_interval import Array, Interval, Motion, evaluate
from ballfg.estimate.online_isam import IncrementalWindow, Sample
from ballfg.factors.bridge import STATE_KEY


class Window(IncrementalWindow):
    """The window of the online estimator: arguments and attributes as those of `IncrementalWindow`."""

    def __len__(self) -> int:
        return len(self.samples)

    def retract(self, count: int) -> list[Sample]:
        """Take the newest samples back, with their states and factors; iSAM2 forgets them.

        Args: count: how many stay, at least 1.
        Returns: the samples taken back, oldest first, ready to be appended again.
        """
        gone = self.samples[count:]
        slots = [slot for sample in gone for slot in sample.slots]
        slots += [i.slot for i in self.intervals[count - 1 :] if i is not None and i.slot is not None]
        self._relinearize(None)
        del self.samples[count:], self.intervals[count - 1 :]
        self._update(gtsam.NonlinearFactorGraph(), gtsam.Values(), slots, {})
        self.theta = self.theta[:count]
        self._read_back()
        for sample in gone:
            sample.slots = ()
        return gone

    def replace_sigma(self, k: int, sigma: Array) -> None:
        """Give sample k of the window another standard deviation (3,) m: its factor is taken out, another put in."""
        sample = self.samples[k]
        sample.sigma = sigma
        self._relinearize(None)
        graph = gtsam.NonlinearFactorGraph()
        graph.push_back(self._position_factor(sample, self.first + k))
        slots = self._update(graph, gtsam.Values(), [sample.slots[0]], {})
        sample.slots = (slots[0], *sample.slots[1:])
        self._read_back()

    def replace_motion(self, k: int, motion: Motion) -> None:
        """Give the linked interval k of the window another motion, about the same linearisation points."""
        old = self.intervals[k]
        assert old is not None
        dt = self.samples[k + 1].time - self.samples[k].time
        new = Interval(self.first + k, motion, dt, self.model, self.settings.process)
        self._relinearize(None)
        evaluate([new], self.theta[k : k + 1], self.theta[k + 1 : k + 2], self.coefficient_theta)
        graph = gtsam.NonlinearFactorGraph()
        graph.push_back(new.bridge.factor(0))
        assert old.slot is not None
        (new.slot,) = self._update(graph, gtsam.Values(), [old.slot], {})
        self.intervals[k] = new
        self._read_back()

    def drop_oldest(self) -> None:
        """Marginalise the oldest state: what it knew becomes a linear factor on the next state and the coefficients.

        Their linearisation points are fixed from then on, as GTSAM does it.
        Raises: RuntimeError: if the state is not a leaf of iSAM2's tree; the window must then be built anew.
        """
        leaf = gtsam.KeyList()
        leaf.push_back(STATE_KEY + self.first)
        made, deleted = self.isam.marginalizeLeavesWithIndices(leaf)
        self.summary_slots = (self.summary_slots - set(deleted)) | set(made)
        self.first += 1
        del self.samples[0], self.intervals[0]
        self.theta, self.delta = self.theta[1:], self.delta[1:]
        self.fixed = True

    def start_anew(self) -> None:
        """Throw iSAM2 away, after an error left it half-updated, and take in all samples of the window again.

        Raises: RuntimeError or ValueError: if that fails as well.
        """
        samples = self.samples
        motions = [Motion(linked=False), *(i.motion if i else Motion(linked=False) for i in self.intervals)]
        state, coefficients = self.states[:1], self.coefficients
        summaries = self.summaries()
        self._clear()
        self.samples, self.intervals, self.summary_slots = [], [], set()
        for sample in samples:
            sample.slots = ()
        if any(STATE_KEY + self.first in summary.keys() for summary in summaries):
            self.coefficient_theta = coefficients
            self._insert(samples[0], state[0], None, summaries=summaries)
            samples, motions = samples[1:], motions[1:]
        for sample, motion in zip(samples, motions, strict=True):
            self.append(sample, motion)
