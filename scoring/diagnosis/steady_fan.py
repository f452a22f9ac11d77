"""The torque balance of a healthy fan at a steady speed: what a change of the speed means for drag, friction and gain.

A fault is known as a share of the top speed. The fan that it slows down settles where the torque of the same command
is what it needs, so the change of one parameter follows:

    command = friction + viscous w + drag w^2
"""

from __future__ import annotations

from dataclasses import dataclass

from fantwin.scoring.diagnosis.causes import Size

OF_BALANCE = (Size.DRAG, Size.FRICTION, Size.TORQUE, Size.GAIN)
LEAST_SPEED = 0.05
"""share of the top speed: no fan is taken to turn slower"""
LEAST_DRAG = 0.1
"""share of the torque at the top speed: a smaller drag is not what a fault changes"""


@dataclass(frozen=True)
class SteadyFan:
    """Fan of the twin's card at steady speed. Torque is in the unit of the command."""

    viscous: float
    drag: float
    friction: float
    top_rad_s: float
    has_own_drive: bool = False
    """true if it controls its speed by itself: its torque is then not known, and a fault is a share of the speed"""

    def needed(self, speed_rad_s: float) -> float:
        """Command that holds a speed."""
        return max(self.friction + (self.viscous + self.drag * speed_rad_s) * speed_rad_s, 1e-9)

    def tells(self, size: Size) -> bool:
        """Return whether the balance gives this size."""
        if size == Size.DRAG and self.drag * self.top_rad_s**2 < LEAST_DRAG * self.needed(self.top_rad_s):
            return False
        return not self.has_own_drive

    def size_of(self, size: Size, share: float) -> float:
        """Change that makes the top speed another by a share: relative to drag or gain, or to the torque at the top
        speed."""
        speed = max(1.0 + share, LEAST_SPEED) * self.top_rad_s
        at_top = self.needed(self.top_rad_s)
        taken = at_top - self.needed(speed)
        if size == Size.DRAG:
            return taken / (self.drag * speed**2)
        return -taken / at_top if size == Size.GAIN else taken / at_top
