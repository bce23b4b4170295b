"""Fast CPU kernel: the same numbers as `recurrent.py` and `foresight.py`, compiled.

From the inside out: `matmul` multiplies a few rows by a small matrix, `activations` squashes, `sequence` walks a whole
episode forth (with foresight) and back (gradients), `packing` lays the weights out for it, and `unroll` offers it
behind the signature of [`UFRNN`].
"""
