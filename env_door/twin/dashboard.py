"""The dashboard server on port 29999: what a person does on the teach pendant, as lines of text.

Replies are those of an e-Series controller, which clients compare letter by letter.
"""

from collections.abc import Callable

from env_door.twin.controller import Controller
from env_door.twin.lines import LinePeer
from env_door.twin.network import Connection
from env_door.twin.rtde import VERSION

REFUSED_LOCALLY = ("play", "stop", "pause", "power on", "power off", "brake release", "unlock protective stop")
"""Commands that a controller in local control leaves to the person in front of it."""


class Dashboard(LinePeer):
    """One client of the dashboard server.

    Args:
        connection (`Connection`):
            Its connection.
        controller (`Controller`):
            The controller.
    """

    def __init__(self, connection: Connection, controller: Controller):
        super().__init__(connection)
        self._controller = controller
        self._commands: dict[str, Callable[[], str]] = {
            "play": lambda: "Starting program" if controller.play() else "Failed to execute: play",
            "pause": lambda: "Pausing program" if controller.pause() else "Failed to execute: pause",
            "stop": self._stop,
            "running": lambda: f"Program running: {str(controller.program_state.name == 'PLAYING').lower()}",
            "programstate": lambda: f"{controller.program_state.name} <unnamed>",
            "get loaded program": lambda: "No program loaded",
            "isprogramsaved": lambda: "false <unnamed>",
            "robotmode": lambda: f"Robotmode: {controller.robot_mode.name}",
            "safetymode": lambda: f"Safetymode: {controller.safety_mode.name}",
            "safetystatus": lambda: f"Safetystatus: {controller.safety_mode.name}",
            "is in remote control": lambda: str(controller.remote_control).lower(),
            "unlock protective stop": self._unlock,
            "close safety popup": lambda: "closing safety popup",
            "close popup": lambda: "closing popup",
            "power on": lambda: self._do(controller.power_on, "Powering on"),
            "power off": lambda: self._do(controller.power_off, "Powering off"),
            "brake release": lambda: self._do(controller.release_brakes, "Brake releasing"),
            "polyscopeversion": lambda: f"URSoftware {'.'.join(map(str, VERSION))} (Oct 15 2023)",
            "get serial number": lambda: "20235500001",
            "get robot model": lambda: "UR5",
        }
        connection.send(b"Connected: Universal Robots Dashboard Server\n")

    def line(self, line: str) -> None:
        """Carries out one command."""
        command = line.lower()
        if command == "quit":
            self.connection.send(b"Disconnected\n")
            self.connection.close()
            return
        self.connection.send(f"{self._answer(command, line)}\n".encode())

    def _answer(self, command: str, line: str) -> str:
        if command in REFUSED_LOCALLY and not self._controller.remote_control:
            return f"Failed to execute: {command}"
        if command in self._commands:
            return self._commands[command]()
        if command.startswith("popup"):
            return "showing popup"
        if command.startswith("addtolog"):
            return "Added log message"
        return f"could not understand: '{line}'"

    def _stop(self) -> str:
        # Clients send this after their script has ended by itself, and take anything else for a failure.
        return self._do(self._controller.stop_program, "Stopped")

    def _unlock(self) -> str:
        if self._controller.unlock():
            return "Protective stop releasing"
        return (
            "Cannot unlock protective stop until 5s after occurrence. "
            "Always inspect cause of protective stop before unlocking"
        )

    @staticmethod
    def _do(action: Callable[[], None], answer: str) -> str:
        action()
        return answer
