"""The version of the rules by which the stages decide.

A recording names its version (`decision_rules` in its metadata), so that a replay of an older one decides as the stages
did then. A change of the rules that changes decisions on recorded samples gets a new number here; the stages ask for
the rule by `Context.decision_rules`.
"""

from __future__ import annotations

from enum import IntEnum


class DecisionRules(IntEnum):
    """Each version, and what it changed."""

    FIRST = 1
    """of recordings without the entry: statistics kept their state over gaps of any length"""
    TIME_AND_GAPS = 2
    """Statistics start again after a gap longer than their memory, and alarms are not confirmed until they are judged
    again. A backlog, a step of the host's clock and samples of another time are distinguished."""
    BREAKS = 3
    """The twin starts again where the grid does not continue: with another session of the resampler, another segment of
    the clock of the device, or a gap in which the command has moved."""
    RATE_OF_LINE = 4
    """Times of the grid that are not configured follow from the line. Before they were those of `FORMER_DEFAULTS`."""
    HOLDING = 5
    """An alarm returns by the detectors that exceeded, each after its own off-delay, and only where its fault would
    show; meanwhile the fan's baselines stay. Baselines are not commissioned from a fan that changes its speed. Less
    probable causes are not listed, and a diagnosis that says nothing new is not sent."""
    FIRST_DELAY = 6
    """Times of a line begin with the smallest delay of its first second, not with that of its first sample."""
    AT_REST = 7
    """A fan that stands as commanded is judged: its alarm keeps its data, and an alarm of a fan that turned although it
    was stopped returns. The longer an alarm has stood, the longer it must be gone. Causes account for what the tacho
    resolves, and one of standstill stays when the fan turns again."""
    ONE_ALARM = 8
    """A fault is one alarm. It begins to return below half of its limit and not below three quarters; of a tacho that
    counts it lasts ten counts at least, and not a second. Missing readings are counted as they arrive: between readings
    that are near enough the grid has a speed all the same, and hides most of those that a loose wire costs. Readings of
    a tacho that counts may be unsteady while the fan changes its speed, and repeat where a healthy fan would read the
    same."""
    LOSSES_OF_LINE = 9
    """The rate of a line is that at which its device sends, also if samples are lost while it is measured. Before, it
    was that at which they arrived."""
    FALLS = 10
    """The causes of a fan that slows down include those of one that comes to rest. Before, they were named once it
    stood."""
    FIRST_MOTION = 11
    """A first form of HEALTHY_MOTION, used for two days. Such recordings are decided as those of FALLS."""
    FIRST_SPEEDS = 12
    """The same."""
    HEALTHY_MOTION = 13
    """Limits widen while readings change, as far as those of a healthy fan may. Before, they did with any change, also
    by a fault. An alarm returns at the speeds at which it came, or after ten minutes at others. Before, it did at any
    speed."""
    PLAIN_WORDS = 14
    """Sentences on why a cause is unclear have words for causes, and say that the speed has changed too little. Before,
    they had code names, and said that the command was not moving, even when it was. No decision differs."""
    FIRST_BASELINE = 15
    """Where an interval has fewer than five readings, the first baseline comes from a fan that does not move. Before,
    it came from the first interval, also of a fan that speeds up, and such a fan had an alarm that never returned."""

    UNSEEN = 16
    """Band and limits are wider where the twin was not trained, and at the end of a drive's plateau. Before, they were
    the same there."""
    RUNNING_ON = 17
    """A fan that keeps its speed under a command that stops it has an alarm after three times the longest time in
    which a healthy fan slows down; one that turns again after it has been at rest, a second after its tacho's reach.
    Before, both took three times the longest coast. Residuals that exceed their limits with a standstill return at any
    speed. Before, they returned like others."""
    SHARED_STAYS = 18
    """What the fans of a tray share stays when all of them are commissioned again. Before, it began at zero, and their
    baselines took it as an offset that does not depend on the speed."""
    SHARED_AT_FIRST = 19
    """What the fans share is found while they are commissioned, from their residuals, and their baselines are found
    without it. Before, nothing was shared until fans had baselines, which took it as their own."""
    FAST_FANS = 20
    """What the fans share, a share of their speed, is found from those that turn at least half as fast as the second
    fastest one, and its limit is measured from its value once they have turned fast. Before, idling fans, which say
    little about it, held it back."""
    ROUNDED_WEAR = 21
    """Points of wear are kept to the second, and to a hundredth of their standard error. Before, they had all digits.
    No alarm differs."""
    SMALL_STEPS = 22
    """On a grid that is slower than the training data, the twin takes several steps for each sample, each about as
    long as the sampling period of the training data. Before, it took one, which could be unstable, for example at 1 Hz.
    """
    FEEDBACK = 23
    """The onsets of the last 32 alarms of a fan are kept, so that operators may say of them whether they were true. No
    alarm differs."""


CURRENT_RULES = max(DecisionRules)
FORMER_DEFAULTS = {
    DecisionRules.RATE_OF_LINE: {
        "resampler": {"rate_hz": 100.0, "gap_limit_s": 0.1, "watermark_s": 0.5, "stale_for_s": 5.0}
    },
    DecisionRules.ONE_ALARM: {"scorer": {"deadband": 0.25, "off_delay_s": 1.0}},
}
"""before each version, the settings of a section where a configuration says nothing"""
FORMER_KEYS = ("resampler.block_size",)
"""settings of before that decided nothing: a recorded configuration may have them"""
