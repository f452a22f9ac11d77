"""Priors of the model of a healthy fan: what is known of a population of fans."""

from __future__ import annotations

from typing import Annotated, TypeAlias

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

Positive: TypeAlias = Annotated[float, Field(gt=0)]


@dataclass(frozen=True, config=ConfigDict(extra="forbid", allow_inf_nan=False))
class Priors:
    """Prior standard deviations of a population of fans (shares of the speed unless named otherwise), and how fast the
    states change: ageing, sag of the supply at full load, air and its time constant, local error, wandering."""

    twin_share: Positive = 0.02
    """error of a twin that is common to all speeds"""
    twin_rad_s: Positive = 1.5
    """error that differs over `twin_length`, share of the top speed"""
    twin_length: Positive = 0.12
    largest_twin_share: Positive = 0.1
    plateau: Positive = 0.05
    """error, share of the top speed, of a twin that does not know a plateau, at speeds below `plateau_ends`"""
    plateau_ends: Positive = 0.17
    ageing_per_sqrt_h: Positive = 0.002
    lag_s: Positive = 0.15
    """error of a time constant; as much is new after moving over the whole range"""
    sag: Positive = 0.02
    air: Positive = 0.01
    air_s: Positive = 3600.0
    local_rad_s: Positive = 0.45
    local_length: Positive = 0.1
    """share of the top speed, or of the commands, after which the local error is another"""
    local_s: Positive = 2000.0
    wander: Positive = 0.0025
    wander_s: Positive = 2.0
    count: Positive = 0.7
    """share of the error of a count: counts that follow one another are not independent"""
    half_range: Positive = 0.25
    """white error, of half the range of readings that the tacho may show"""
    balance: Positive = 0.3
    """white error, of the noise of the torque balance; the rest passes its filter"""
    balance_time_s: Positive = 0.04
    """time by which a movement may show earlier or later in the torque balance: its filter is no mean over the same
    time"""
