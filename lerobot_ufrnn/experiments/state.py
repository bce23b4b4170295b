"""Work that is done once: a file beside it says what was asked for, and whether it is done."""

import json
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any


def replace_text(path: Path, text: str) -> None:
    """Writes a text file in one step: a reader sees the old text or the new, and a kill leaves one of them."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    temporary.write_text(text)
    os.replace(temporary, path)


def run_once(name: str, state: Path, request: dict[str, Any], work: Callable[[], None]) -> None:
    """Does some work unless it is done.

    Args:
        name (`str`):
            What to call it.
        state (`Path`):
            JSON file that says what was asked for when the work began, and whether it is done.
        request (`dict[str, Any]`):
            All that the outcome depends on.
        work (`Callable[[], None]`):
            The work; must cope with what an earlier, interrupted call left.

    Raises:
        ValueError: If something else was asked for when the work began.
    """
    request = json.loads(json.dumps(request, default=str))
    before: dict[str, Any] = json.loads(state.read_text()) if state.exists() else {"request": request, "done": False}
    if before["request"] != request:
        changes = "; ".join(_differences(before["request"], request))
        raise ValueError(
            f"{state.parent} was made with other settings: {changes}. Go back to them, give another --output_dir, or "
            "delete that folder to make it anew."
        )
    if before["done"]:
        print(f"[{name}] is done", flush=True)
        return
    print(f"[{name}] begins", flush=True)
    start = time.perf_counter()
    replace_text(state, json.dumps({"request": request, "done": False}, indent=2))
    work()
    replace_text(state, json.dumps({"request": request, "done": True}, indent=2))
    print(f"[{name}] took {time.perf_counter() - start:.0f} s", flush=True)


def _differences(before: dict[str, Any], now: dict[str, Any], prefix: str = "") -> Iterator[str]:
    for key in sorted(before.keys() | now.keys()):
        old, new = before.get(key), now.get(key)
        if isinstance(old, dict) and isinstance(new, dict):
            yield from _differences(old, new, f"{prefix}{key}.")
        elif old != new:
            yield f"{prefix}{key} was {old}, now {new}"
