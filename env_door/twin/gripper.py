"""A Robotiq 2F-85: its variables, what they do to the fingers, and the socket of its URCap on port 63352.

The fingers go at the speed that was set towards the position that was asked for, stop at what is in between and keep
squeezing with the force that was set. It reads 3 when it is open and 230 when it is closed, as a real one does roughly.
"""

import asyncio
import contextlib

from env_door.twin.ports import lines

OPEN, CLOSED = 3, 230  # positions, of 0 to 255, at the ends of the stroke; what is asked for beyond leads to the end
STROKE_SPEEDS = (0.235, 1.765)  # slowest and fastest closing in strokes per second (20 and 150 mm/s of 85 mm)
FORCES = (20.0, 235.0)  # weakest and strongest grip in N
ACTIVATION_SECONDS = 1.0  # the real gripper closes and opens meanwhile; this one only opens
BLOCKED_SECONDS = 0.06  # for which the fingers must stand short of the target to count as stopped by an object

# Faults; those of activation end with it.
ACTIVATING_FAULT = 5  # asked to move while it is being activated, after which it moves
NOT_ACTIVATED = 7  # asked to move before it was activated
MAJOR_FAULT = 10  # from here on they stop the gripper until it is activated again (`SET ACT 0`, then `SET ACT 1`)

RESET, ACTIVATING, ACTIVE = 0, 1, 3
MOVING, BLOCKED_OPENING, BLOCKED_CLOSING, AT_TARGET = 0, 1, 2, 3


class GripperModel:
    """The gripper's variables, and the closure to drive the fingers to: `target`, 0 open to 1 closed."""

    def __init__(self) -> None:
        self.silent = self.garbage = False  # whether the socket answers nothing, or nonsense
        self._cause = 0  # a fault that comes back with every activation; 0 for none
        self.switch_off()
        self.switch_on(0.0)

    def switch_off(self) -> None:
        """Takes its power away: afterwards it must be activated."""
        self.powered = False
        self._set = {"ACT": 0, "GTO": 0, "ATR": 0, "ARD": 0, "FOR": 0, "SPE": 0, "POS": 0}
        self._status, self._fault, self._object = RESET, 0, MOVING
        self._activating = self._still = 0.0
        self.target = self._measured = 0.0

    def switch_on(self, closure: float) -> None:
        """Gives it power again; the fingers stay where they are."""
        self.powered = True
        self.target = self._measured = closure

    def open_at_once(self) -> None:
        """Forgets the last request: a new trial starts with open fingers. An activated gripper stays activated."""
        self._set["POS"] = 0
        self.target = self._measured = 0.0

    @property
    def force(self) -> float:
        """Force in N with which it squeezes."""
        return FORCES[0] + (FORCES[1] - FORCES[0]) * self._set["FOR"] / 255

    def fail(self, code: int) -> None:
        """Breaks it with a fault of 1 to 15; 0 takes the cause away, though a major fault lasts until activation."""
        self._cause = code
        if code or self._fault < MAJOR_FAULT:
            self._fault = code

    def step(self, closure: float, seconds: float) -> None:
        """Goes on in time, with a measured closure of 0 open to 1 closed."""
        moved, self._measured = abs(closure - self._measured), closure
        if self._status == ACTIVATING:
            self._activating -= seconds
            self._approach(0.0, seconds)
            if self._activating <= 0:
                self._status, self._fault = ACTIVE, self._cause
        elif self._status == ACTIVE and self._set["GTO"] and self._fault < MAJOR_FAULT:
            self._approach(self._goal, seconds)
        self._still = self._still + seconds if moved < 0.02 * seconds else 0.0
        self._object = self._detect(closure)

    @property
    def _goal(self) -> float:
        return min(max((self._set["POS"] - OPEN) / (CLOSED - OPEN), 0.0), 1.0)

    def _approach(self, goal: float, seconds: float) -> None:
        slow, fast = STROKE_SPEEDS
        step = (slow + (fast - slow) * self._set["SPE"] / 255) * seconds
        self.target += min(max(goal - self.target, -step), step)

    def _detect(self, closure: float) -> int:
        if self._still < BLOCKED_SECONDS or not self._set["GTO"]:
            return MOVING
        if abs(self._goal - closure) <= 3 / 255:
            return AT_TARGET
        # Only fingers that push and do not move have met something.
        if abs(self.target - closure) < 0.01:
            return MOVING
        return BLOCKED_CLOSING if self.target > closure else BLOCKED_OPENING

    def get(self, name: str) -> str:
        """Value of a variable; `"?"` for an unknown one and while the gripper has no power."""
        if not self.powered:
            return "?"
        position = round(OPEN + min(max(self._measured, 0.0), 1.0) * (CLOSED - OPEN))
        status = {"STA": self._status, "OBJ": self._object, "FLT": self._fault, "POS": position}
        return str((self._set | status | {"PRE": self._set["POS"]}).get(name, "?"))

    def set(self, values: dict[str, int]) -> bool:
        """Sets variables; whether they were taken: all or none."""
        known = all(name in self._set and 0 <= value <= 255 for name, value in values.items())
        if not (self.powered and values and known):
            return False
        was_active = self._set["ACT"]
        self._set |= values
        if values.get("ACT") == 0:
            self._status, self._fault = RESET, 0
            self._set["GTO"] = 0
            self.target = self._measured
        elif self._set["ACT"] and not was_active:
            self._status, self._fault, self._activating = ACTIVATING, self._cause, ACTIVATION_SECONDS
            self._set["POS"] = values.get("POS", 0)
        elif self._status == ACTIVATING and "POS" in values:
            self._fault = self._fault or ACTIVATING_FAULT
        if "GTO" in values or "POS" in values:
            if self._status == RESET and self._set["GTO"]:
                self._fault = NOT_ACTIVATED
            elif not self._set["GTO"]:
                self.target = self._measured
            self._still, self._object = 0.0, MOVING
        return True

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answers the requests of one client."""
        async for line in lines(reader):
            if not self.silent:
                writer.write(b"\xff\x00#?!\n" if self.garbage else self.answer(line).encode())

    def answer(self, line: str) -> str:
        """Answers a request of the URCap's text protocol: `SET ACT 1 GTO 1` with `ack`, `GET POS` with `POS 3`."""
        match line.split():
            case ["GET", name]:
                return f"{name} {self.get(name)}\n"
            case ["SET", *words]:
                with contextlib.suppress(ValueError, OverflowError):
                    values = zip(words[::2], words[1::2], strict=True)
                    if self.set({name: round(float(value)) for name, value in values}):
                        return "ack"  # clients compare with exactly these three letters: no end of line
        return "?\n"
