"""Measures each part and lays it out as a table with its targets."""

from dataclasses import asdict
from pathlib import Path

from ..modeling_ufrnn import UFRNNPolicy
from .acting import ACT, CYCLE, DIFFUSION, FAST, RECALL, REFERENCE, ActingTimes, measure_policies
from .door_features import door_separability
from .environment import measure_env
from .growth import TOLERANCE, measure_growth
from .pipeline import measure_demo
from .report import Section, Target
from .update import FAST as FAST_UPDATE
from .update import REFERENCE as REFERENCE_UPDATE
from .update import SCAN, measure_update

FEATURE_SEEDS = range(1000, 1012)
"""Seeds of the doors that features are judged by; no demonstration of the demo has them."""

MAX_EXPONENT = 1.1
"""Largest slope of log time over log size that still counts as linear growth."""


def of_update(seconds: float) -> Section:
    """A training update against the reference and the scan."""
    times = measure_update(seconds)
    pairs = [(REFERENCE_UPDATE, times.with_reference), (SCAN, times.with_scan)]
    rows, values = [], {}
    for name, rounds in pairs:
        if rounds is None:
            rows.append([name, "JAX is not installed", "", ""])
            continue
        ratio = rounds.ratio(name, FAST_UPDATE)
        rows.append([name, rounds.spread(FAST_UPDATE).text(1e3), rounds.spread(name).text(1e3), ratio.text()])
        values[name] = {
            "fast_seconds": asdict(rounds.spread(FAST_UPDATE)),
            "seconds": asdict(rounds.spread(name)),
            "ratio_to_fast": asdict(ratio),
        }
    speedup = times.with_reference.ratio(REFERENCE_UPDATE, FAST_UPDATE).median
    against_scan = None if times.with_scan is None else times.with_scan.ratio(FAST_UPDATE, SCAN).median
    return Section(
        "Training update",
        ("competitor", "fast kernel / ms", "competitor / ms", "times the fast kernel's time"),
        rows,
        "Noise, forward pass with foresight, loss, gradients, clipping and Adam at the paper's sizes (5 episodes of "
        "150 frames, N 5, T 10, hidden 50/50/20, 7 joints, 10 features); one thread, same CPU.",
        (
            Target("update: times faster than the reference", speedup, 8, at_least=True),
            Target("update: time as a multiple of the scan's", against_scan, 1, at_least=False),
        ),
        values,
    )


def of_acting(seconds: float) -> Section:
    """`select_action` of every policy."""
    times = measure_policies(seconds)
    p99 = times[FAST].percentile(99)
    rows = [_acting_row(name, of_policy, p99) for name, of_policy in times.items()]
    targets = [Target("select_action: p99 / ms", 1e3 * p99, 2, at_least=False)]
    for name, factor in ((DIFFUSION, 100), (ACT, 10)):
        worst = times[name].worst_against(p99).median if name in times else None
        targets.append(Target(f"select_action: {name}'s worst tick as a multiple of our p99", worst, factor, True))
    values = {
        name: {
            "p50_seconds": of_policy.percentile(50),
            "p99_seconds": of_policy.percentile(99),
            "worst_tick_seconds": asdict(of_policy.worst),
            "amortised_seconds": asdict(of_policy.amortised),
            "worst_tick_to_our_p99": asdict(of_policy.worst_against(p99)),
        }
        for name, of_policy in times.items()
    }
    return Section(
        "select_action at batch 1",
        ("policy", "ticks", "p50 / ms", "p99 / ms", "worst tick / ms", "amortised / ms", "worst tick / our p99"),
        rows,
        "One camera of 128 x 128 pixels, encoder included, random weights, defaults of LeRobot, one thread. ACT and "
        "Diffusion Policy compute a chunk of actions in one tick and only read it in the next ones. The worst tick is "
        f"the longest of each chunk, for UF-RNN the longest of {CYCLE}; amortised is the mean over it. With recall the "
        "worst tick is one that goes back and imagines.",
        targets,
        values,
    )


def _acting_row(name: str, times: ActingTimes, p99: float) -> list[str]:
    return [
        name,
        str(len(times.ticks)),
        f"{1e3 * times.percentile(50):.3g}",
        f"{1e3 * times.percentile(99):.3g}",
        times.worst.text(1e3),
        times.amortised.text(1e3),
        "-" if name in (FAST, REFERENCE, RECALL) else times.worst_against(p99).text(),
    ]


def of_growth(seconds: float) -> Section:
    """How the fast kernel's time grows."""
    growths = measure_growth(seconds)
    rows = [
        [
            growth.name,
            ", ".join(
                f"{size:g}: {spread.text(1e3)}" for size, spread in zip(growth.sizes, growth.seconds, strict=True)
            ),
            f"{growth.exponent:.2f}",
            growth.verdict,
        ]
        for growth in growths
    ]
    targets = []
    for growth in growths:
        if growth.name in ("T", "L"):
            distance = float(abs(growth.residuals).max())
            name = f"growth with {growth.name}: largest relative distance from a straight line"
            targets.append(Target(name, distance, TOLERANCE, at_least=False))
        elif growth.name in ("N", "batch"):
            name = f"growth with {growth.name}: exponent"
            targets.append(Target(name, growth.exponent, MAX_EXPONENT, at_least=False))
    return Section(
        "Growth",
        ("what", "size: ms of a forward and backward pass", "exponent", "verdict"),
        rows,
        "Fast kernel on one thread, one size varied at a time around the paper's. The exponent is the slope of log "
        "time over log size for the three largest; linear means that a fixed cost and a constant cost for each unit "
        f"explain every point within {TOLERANCE:.0%}.",
        targets,
        [asdict(growth) | {"exponent": growth.exponent, "verdict": growth.verdict} for growth in growths],
    )


def of_environment(seconds: float) -> Section:
    """Steps a second of the door."""
    speeds = measure_env(seconds)
    rows = [[s.name, f"{s.median:.3g} [{s.low:.3g}, {s.high:.3g}]", str(s.calls)] for s in speeds]
    return Section(
        "Door environment",
        ("what", "environment steps a second", "calls"),
        rows,
        "The gripper holds the knob. A batch of five counts as five steps.",
        values=[asdict(speed) for speed in speeds],
    )


def of_pipeline(output_dir: Path) -> list[Section]:
    """A whole demo, stage by stage.

    Args:
        output_dir (`Path`):
            Where the demo may work; it must be empty or missing.
    """
    stages, speed = measure_demo(output_dir)
    total = sum(stage.seconds for stage in stages)
    rows = [[stage.name, f"{stage.seconds:.0f}", f"{stage.peak_bytes / 2**20:.0f}"] for stage in stages]
    rows.append(["all", f"{total:.0f}", f"{max(stage.peak_bytes for stage in stages) / 2**20:.0f}"])
    sections = [
        Section(
            "Main job (`ufrnn demo`)",
            ("stage", "seconds", "peak memory / MiB"),
            rows,
            "Default flags, threads as the environment allows. Memory of all processes together.",
            (
                Target("main job / min", total / 60, 15, at_least=False),
                Target(
                    "main job: peak memory / GB", max(stage.peak_bytes for stage in stages) / 1e9, 2, at_least=False
                ),
            ),
            [asdict(stage) for stage in stages],
        ),
        of_features(output_dir / "checkpoint"),
    ]
    if speed is not None:
        sections.append(
            Section(
                "Stock training on encoded episodes",
                ("update / ms", "data / ms"),
                [[f"{1e3 * speed.update_seconds:.0f}", f"{1e3 * speed.data_seconds:.0f}"]],
                "Medians of `updt_s` and `data_s`, as `lerobot-train` logs them, once the image encoder is frozen.",
                (
                    Target(
                        "stock training: data as a fraction of the update",
                        speed.data_seconds / speed.update_seconds,
                        0.3,
                        at_least=False,
                    ),
                ),
                asdict(speed),
            )
        )
    return sections


def of_features(policy_path: Path) -> Section:
    """How well a trained policy's image features tell how far a door is open.

    Args:
        policy_path (`Path`):
            Checkpoint of a policy.
    """
    rows = door_separability(UFRNNPolicy.from_pretrained(policy_path).image_encoder, FEATURE_SEEDS)
    return Section(
        "Image features of a door closed, 5 and 10 degrees open",
        ("kind", "arm", "accuracy", "d' closed-5", "d' 5-10", "distance closed-5", "accuracy of the kind at 5"),
        [
            [
                row.kind,
                row.arm,
                f"{row.accuracy:.2f}",
                f"{row.d_prime_closed_5:.0f}",
                f"{row.d_prime_5_10:.0f}",
                f"{row.distance_closed_5:.2f}",
                f"{row.kind_accuracy:.2f}",
            ]
            for row in rows
        ],
        "Features after the main job, scaled to [-0.8, 0.8], of doors that training did not see. Accuracy: nearest "
        "class mean, each frame left out of it. d': distance of two class means in standard deviations within the "
        "classes. The arm follows the handle, as in a demonstration, or stays still while the door alone moves.",
        values=[asdict(row) for row in rows],
    )
