"""The dashboard server on port 29999: what a person does on the teach pendant, as lines of text.

Replies are those of an e-Series controller, which clients compare letter by letter.
"""

import asyncio
from collections.abc import Callable

from env_door.twin.controller import Controller, ProgramState
from env_door.twin.ports import lines
from env_door.twin.rtde import VERSION

REFUSED_LOCALLY = ("play", "stop", "pause", "power on", "power off", "brake release", "unlock protective stop")
"""Commands that a controller in local control leaves to the person in front of it."""

STILL_LOCKED = (
    "Cannot unlock protective stop until 5s after occurrence. Always inspect cause of protective stop before unlocking"
)


class Dashboard:
    """The pendant of a controller."""

    def __init__(self, controller: Controller):
        self._controller = controller
        self._commands: dict[str, Callable[[], str]] = {
            "play": lambda: "Starting program" if controller.play() else "Failed to execute: play",
            "pause": lambda: "Pausing program" if controller.pause() else "Failed to execute: pause",
            # Clients send this after their script has ended by itself, and take anything else for a failure.
            "stop": _doing(controller.stop_program, "Stopped"),
            "running": lambda: f"Program running: {str(controller.program_state == ProgramState.PLAYING).lower()}",
            "programstate": lambda: f"{controller.program_state.name} <unnamed>",
            "get loaded program": lambda: "No program loaded",
            "isprogramsaved": lambda: "false <unnamed>",
            "robotmode": lambda: f"Robotmode: {controller.robot_mode.name}",
            "safetymode": lambda: f"Safetymode: {controller.safety_mode.name}",
            "safetystatus": lambda: f"Safetystatus: {controller.safety_mode.name}",
            "is in remote control": lambda: str(controller.remote_control).lower(),
            "unlock protective stop": lambda: "Protective stop releasing" if controller.unlock() else STILL_LOCKED,
            "close safety popup": lambda: "closing safety popup",
            "close popup": lambda: "closing popup",
            "power on": _doing(controller.power_on, "Powering on"),
            "power off": _doing(controller.power_off, "Powering off"),
            "brake release": _doing(controller.release_brakes, "Brake releasing"),
            "polyscopeversion": lambda: f"URSoftware {'.'.join(map(str, VERSION))} (Oct 15 2023)",
            "get serial number": lambda: "20235500001",
            "get robot model": lambda: "UR5",
        }

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Carries out the commands of one client."""
        writer.write(b"Connected: Universal Robots Dashboard Server\n")
        async for line in lines(reader):
            if line.lower() == "quit":
                writer.write(b"Disconnected\n")
                return
            writer.write(f"{self._answer(line)}\n".encode())

    def _answer(self, line: str) -> str:
        command = line.lower()
        if command in REFUSED_LOCALLY and not self._controller.remote_control:
            return f"Failed to execute: {command}"
        if command in self._commands:
            return self._commands[command]()
        if command.startswith("popup"):
            return "showing popup"
        if command.startswith("addtolog"):
            return "Added log message"
        return f"could not understand: '{line}'"


def _doing(action: Callable[[], None], answer: str) -> Callable[[], str]:
    def do() -> str:
        action()
        return answer

    return do
