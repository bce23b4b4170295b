"""`ufrnn curve`: draw the success rate over the epochs of training."""

from dataclasses import dataclass
from pathlib import Path

from ..analysis.evaluation_table import ProtocolRow, read_table
from ..analysis.success_curve import draw
from .flags import parse_flags


@dataclass
class CurveConfig:
    """What to draw.

    Args:
        results (`Path`, *optional*, defaults to `results/door_protocol.csv`):
            Table that `ufrnn protocol` wrote.
        output (`Path`, *optional*, defaults to `results/success_curve.png`):
            Picture to write.
    """

    results: Path = Path("results/door_protocol.csv")
    output: Path = Path("results/success_curve.png")


def run(arguments: list[str]) -> None:
    """Writes the picture."""
    config = parse_flags(CurveConfig, arguments)
    draw(read_table(config.results, ProtocolRow), config.output)
    print(f"Success over epochs: {config.output}")
