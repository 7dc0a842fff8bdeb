"""Defines the segmentation's parameters: noise, prior spreads, prices of events, bounds of the search."""

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class SegmentationSettings:
    """Parameters of the segmentation; docs/derivations/segmentation.md gives the reason for each value."""

    # measurements
    sigma_floor: float = 1.5e-3
    """m. Least standard deviation of a sample: the scatter about a smooth local fit leaves out a tracker's slow errors,
    and with less noise, bends of the path look like hits (docs/derivations/segmentation.md has the counts)."""
    stamp_jitter: float = 3e-4
    """s. Error of the stamps; adds speed times this to the noise along each axis."""
    wide_factor: float = 4.0
    """Noise of a wide sample divided by the stated one."""
    wide_share: float = 0.05
    """Prior share of wide samples."""
    outlier_spread: float = 0.3
    """m. Standard deviation of outliers about the ball."""
    outlier_share: float = 0.01
    """Prior share of outliers."""
    outlier_doubt: float = 10.0
    """nats. A sample with a smaller advantage as the ball is tried as an outlier, too. If the path is known to some
    millimetres the advantage is 18, at the second sample of a track 8."""
    doubt_margin: float = 25.0
    """nats. Largest distance of the resulting hypothesis from the best one, for that trial."""

    # flight, apart from gravity and drag: lift, wind and a wrong drag are an acceleration, the slack
    slack: float = 4.0
    """m/s^2. Its spread at the start of a segment, where the speed is unknown."""
    still_air: float = 0.7
    """m/s^2. Its spread for a slow ball, which no air can hold up."""
    air_growth: float = 0.45
    """Growth of this spread, over the ball's own drag: lift of a spinning ball. `strokes` and `spindoe` judged it."""
    air_memory: float = 0.5
    """s. Time constant within which the slack forgets itself."""
    velocity_drift: float = 0.05
    """m/s per sqrt(s). Random walk of the velocity."""
    velocity_spread: float = 15.0
    """m/s. Spread, per axis, of an unknown velocity; a tennis serve at 60 m/s costs 8 nats."""

    # contacts
    contact_cost: float = 1.0
    """nats."""
    surface_sigma: float = 0.004
    """m. Error of the height at which the ball bounces: declared height, calibration, compression of the ball."""
    restitution_sigma: float = 0.06
    """Spread of the restitution on the table."""
    floor_restitution_sigma: float = 0.15
    """Spread of the restitution on the floor, which a model of the table hardly describes."""
    most_slowing: float = 0.15
    """Largest expected share of the tangential velocity that a bounce of unknown spin removes."""
    contact_window: float = 0.012
    """s. Largest distance of a predicted contact outside of its interval."""
    extent_margin: float = 0.05
    """m. Largest distance of a contact outside of a known table."""

    # rest
    rest_speed: float = 0.2
    """m/s. A ball that lands more slowly may stay down."""
    rest_cost: float = 1.2
    """nats."""
    start_at_rest_cost: float = 7.0
    """nats, of a rest at a start or after a hit, without a seen landing: two samples near a surface gain as much by
    chance, ten reveal a rest."""
    rest_range: float = 0.02
    """m. Largest distance of a resting ball's first sample, or of its first after a hit, from the surface."""
    leave_cost: float = 5.0
    """nats in addition to the prior rate of hits: a resting ball leaves over an edge, and then it stays away."""
    leave_speed: float = 0.15
    """m/s. Spread of the vertical velocity with which a resting ball gets into the air."""

    # hits, tracker shifts, gaps
    hit_rate: float = 1.0
    """1/s. Prior rate of hits, and of a resting ball leaving."""
    hit_cost: float = 7.0
    """nats in addition to the prior rate; fades in gaps, where no sample could show a hit."""
    hit_spread: float = 0.03
    """m. Spread of the ball's place after a hit about the prediction, apart from its unknown velocity."""
    shift_rate: float = 1.0
    """1/s. Prior rate of tracker shifts."""
    shift_cost: float = 4.0
    """nats in addition to the prior rate."""
    shift_spread: float = 0.03
    """m. Spread of a shift, per axis."""
    shift_level: float = 0.02
    """m. Samples whose offset differs by more from that of most of their segment are marked `SHIFTED`."""
    short_gap: float = 0.1
    """s. Over longer gaps no shift is tried, and a hit does not use the prediction."""
    longest_gap: float = 0.5
    """s. Nothing links the two sides of a longer gap: the slack alone moves the ball by half a metre."""
    longest_unseen: float = math.inf
    """s. Nothing links the two sides of a longer gap in which the ball may meet a surface; the smoother compares
    numbers of bounces instead."""
    friction_excess: float = 1.4
    """Tangential jump of a contact, in units of the largest by friction, beyond which a hit is added."""

    # search
    surprise: float = 6.0
    """Squared whitened innovation (3 degrees of freedom) from which hits and shifts are tried: one good sample in nine
    exceeds it, and every relevant event does so within two samples."""
    longest_step: float = 0.04
    """s. Longer intervals are cut, so that several bounces fit into them."""
    mature: int = 25
    """Samples after its last event after which a hypothesis merges with others in the same mode; the best remains."""
    most: int = 40
    """Largest number of hypotheses."""
    margin: float = 60.0
    """nats. Hypotheses this far behind the best are dropped: more than a hit's price twice."""
    lag: int = 64
    """Samples after which an event is final."""
