"""How this package's functions are compiled, and where their machine code is kept."""

import hashlib
import os
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba

settings: Any = numba.config  # a module whose names are made at run time

# Sums may be re-ordered and fused, but NaN and infinity keep their meaning: broken weights must be noticed.
FAST_MATH = {"contract", "reassoc", "nsz", "arcp"}


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compiles a function with Numba for the processor it runs on, and keeps the machine code on disk.

    The first call ever takes some seconds, later processes load the result. Where no folder can be written, each
    process compiles anew.

    Args:
        function (`Callable`):
            Function on NumPy arrays, in Numba's subset of Python.

    Returns:
        `Callable`: the compiled function; it releases the GIL.
    """
    options: dict[str, Any] = {"fastmath": FAST_MATH, "error_model": "numpy", "nogil": True}
    folder = _cache_folder()
    if folder is None:
        return numba.njit(**options)(function)
    before = settings.CACHE_DIR
    settings.CACHE_DIR = folder
    try:
        return numba.njit(cache=True, **options)(function)
    finally:
        settings.CACHE_DIR = before


@cache
def _cache_folder() -> str | None:
    """A folder for exactly this code: Numba itself would not notice a change in a file that a function calls into."""
    here = Path(__file__).parent
    code = b"".join(file.read_bytes() for file in sorted(here.glob("*.py")))
    name = f"ufrnn-{hashlib.sha256(code).hexdigest()[:16]}"
    asked_for = [Path(settings.CACHE_DIR)] if settings.CACHE_DIR else []
    for base in (*asked_for, here / "__pycache__", Path.home() / ".cache"):
        folder = base / name
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            return str(folder)
    return None
