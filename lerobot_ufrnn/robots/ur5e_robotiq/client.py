"""The client library of the controller."""

from typing import Any


def import_client(what: str = "--robot.type=ur5e_robotiq") -> tuple[Any, Any, Any]:
    """The three interfaces of `ur_rtde`.

    Args:
        what (`str`, *optional*):
            What needs it.

    Returns:
        `tuple`: the modules `rtde_control`, `rtde_receive` and `dashboard_client`.

    Raises:
        ImportError: If it is not installed; says how to.
    """
    try:
        import dashboard_client
        import rtde_control
        import rtde_receive
    except ImportError as error:
        raise ImportError(
            f"{what} needs ur_rtde, which cannot be imported ({error}): `pip install 'lerobot_policy_ufrnn[ur5e]'`. "
            "Everything else works without it."
        ) from error
    return rtde_control, rtde_receive, dashboard_client
