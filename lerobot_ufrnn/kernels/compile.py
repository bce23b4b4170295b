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
    process compiles anew. Compiled functions release the GIL.
    """
    before, folder = settings.CACHE_DIR, _cache_folder()
    settings.CACHE_DIR = folder or before
    try:
        return numba.njit(cache=bool(folder), fastmath=FAST_MATH, error_model="numpy", nogil=True)(function)
    finally:
        settings.CACHE_DIR = before


@cache
def _cache_folder() -> str | None:
    """A folder for exactly this code: Numba itself would not notice a change in a file that a function calls into."""
    here = Path(__file__).parent
    code = b"".join(file.read_bytes() for file in sorted(here.glob("*.py")))
    name = f"ufrnn-{hashlib.sha256(code).hexdigest()[:16]}"
    for base in filter(None, (settings.CACHE_DIR, here / "__pycache__", Path.home() / ".cache")):
        folder = Path(base, name)
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            return str(folder)
    return None
