"""Fast CPU kernel: the same numbers as `recurrent.py` and `foresight.py`, compiled.

From the inside out: `matmul` multiplies a few rows by a small matrix, `activations` squashes, `walk` goes through
whole episodes with foresight and `walk_back` back again for the gradients, `layout` names what they pass to each other,
`packing` lays the weights out for them, and `unroll` offers it all behind the signature of [`UFRNN`].
"""
