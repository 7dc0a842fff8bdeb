"""The numbers of the segmentation: noise, prior spreads, prices of events, bounds of the search."""

from dataclasses import dataclass


@dataclass(frozen=True)
class SegmentationSettings:
    """What the segmentation takes for granted; docs/derivations/segmentation.md says why each number is what it is."""

    # measurements
    sigma_floor: float = 1.5e-3
    """m. Smaller stated noise is raised to this: what a smooth local fit sees of a tracker leaves out its slow errors,
    and with less, bends of the path are taken for hits (docs/derivations/segmentation.md has the counts)."""
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
    """nats. A sample that is the ball by less than this is tried as an outlier, too. Where the path is known to some
    millimetres the difference is 18, at the second sample of a track 8."""
    doubt_margin: float = 25.0
    """nats. Only where that leaves the hypothesis less than this behind the best."""

    # flight, apart from gravity and drag: spin, wind and a wrong drag act as a slowly drifting acceleration
    slack: float = 4.0
    """m/s^2. Spread of that acceleration at the start of a segment."""
    slack_drift: float = 6.0
    """m/s^2 per sqrt(s). Its random walk."""
    velocity_drift: float = 0.05
    """m/s per sqrt(s). Random walk of the velocity."""
    velocity_spread: float = 15.0
    """m/s. Spread, per axis, of the velocity of which nothing is known; a tennis serve at 60 m/s pays 8 nats."""

    # contacts
    contact_cost: float = 1.0
    """nats."""
    surface_sigma: float = 0.004
    """m. Error of the height at which the ball bounces: declared height, calibration, compression of the ball."""
    restitution_sigma: float = 0.06
    """Spread of the restitution on the table."""
    floor_restitution_sigma: float = 0.15
    """The same on the floor, of which a model of the table says little."""
    most_slowing: float = 0.15
    """Largest share of its tangential velocity that a bounce of unknown spin is expected to take."""
    slack_at_contact: float = 3.0
    """m/s^2. A bounce changes the spin, and so the slack acceleration."""
    contact_window: float = 0.012
    """s. How far outside an interval a contact may be predicted and still be tried."""
    extent_margin: float = 0.05
    """m. Contacts this far outside a known table are still tried."""

    # rest
    rest_speed: float = 0.2
    """m/s. A ball that lands more slowly may stay down."""
    rest_cost: float = 1.2
    """nats."""
    start_at_rest_cost: float = 7.0
    """nats, of a rest at a start or after a hit, where no landing was seen: two samples near a surface gain as much by
    chance, ten give a rest away."""
    rest_range: float = 0.02
    """m. A first sample, or one after a hit, this close to a surface may be that of a resting ball."""
    leave_cost: float = 5.0
    """nats on top of the prior rate of hits: a resting ball leaves over an edge, and then it stays away."""
    leave_speed: float = 0.15
    """m/s. Spread of the vertical velocity with which a resting ball gets into the air."""

    # hits, tracker shifts, gaps
    hit_rate: float = 1.0
    """1/s. Prior rate of hits, and of a resting ball leaving."""
    hit_cost: float = 7.0
    """nats on top of the prior rate; fades in gaps, where a hit needs no witness."""
    hit_spread: float = 0.03
    """m. How far from the prediction a ball may reappear after a hit, apart from its unknown velocity."""
    shift_rate: float = 1.0
    """1/s. Prior rate of tracker shifts."""
    shift_cost: float = 4.0
    """nats on top of the prior rate."""
    shift_spread: float = 0.03
    """m. Spread of a shift, per axis."""
    shift_level: float = 0.02
    """m. Samples whose offset differs by more from that of most of their segment are marked `SHIFTED`."""
    short_gap: float = 0.1
    """s. Over longer gaps no shift is tried, and a hit is judged without the prediction."""
    longest_gap: float = 0.5
    """s. Nothing links the two sides of a longer gap: the slack alone moves the ball by half a metre."""
    friction_excess: float = 1.4
    """Tangential jump of a contact, in units of the largest that friction gives, beyond which a hit lies beside it."""

    # search
    surprise: float = 6.0
    """Squared whitened innovation (3 degrees of freedom) from which hits and shifts are tried: one good sample in
    nine exceeds it, and no event worth its price stays below it for two samples."""
    longest_step: float = 0.04
    """s. Longer intervals are cut, so that several bounces fit into them."""
    mature: int = 25
    """Samples after its last event after which a hypothesis forgets what it was; of several only the best stays."""
    most: int = 40
    """Hypotheses kept."""
    margin: float = 60.0
    """nats. Hypotheses this far behind the best are dropped: more than a hit's price twice."""
    lag: int = 64
    """Samples after which an event is final."""
