"""Command-line flags in LeRobot's style, from a dataclass."""

import draccus
from draccus.utils import DecodingError, ParsingError


def parse_flags[Config](config_class: type[Config], arguments: list[str], prog: str) -> Config:
    """Builds a configuration from flags such as `--seed=3`.

    Args:
        config_class (`type`):
            Dataclass whose fields are the flags; the string below a field explains it in `--help`.
        arguments (`list[str]`):
            Command line without program and command.
        prog (`str`):
            Program and command, for `--help`.

    Returns:
        The configuration.

    Raises:
        ValueError: If a value is of the wrong type or out of range; the message is the dataclass's own.
    """
    try:
        return draccus.parse(config_class, args=arguments, prog=prog)
    except DecodingError as error:  # a value of the wrong type: draccus names the flag
        raise ValueError(str(error)) from error
    except ParsingError as error:  # a value out of range: the dataclass says what is allowed, draccus does not
        raise ValueError(str(error.__cause__ or error)) from error
