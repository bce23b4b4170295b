"""Fast CPU kernel: the same numbers as `foresight.py` and `networks/sh_lstm.py`, compiled.

From the inside out: `forward` goes through whole episodes with foresight and `backward` back again for the gradients,
`layout` names what they pass to each other and lays the weights out for them, and `unroll` offers it all behind the
signature of [`UFRNN`]. Products are BLAS calls, of as few and as large matrices as possible.
"""
