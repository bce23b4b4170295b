"""Product of a few rows with a small matrix, near the peak of a core's arithmetic.

The matrices of a small LSTM are too small for a BLAS, whose call alone costs as much as the product, and a compiler
does not keep a tile of the result in registers by itself. So the innermost tile is written in LLVM's intermediate
language: portable, as LLVM splits the vectors to what the processor has.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from .compile import compiled

LANES = 8
PANEL = 2 * LANES
"""Width of a panel: a matrix (K, C) is stored as panels (C / PANEL, K, PANEL), which are read from start to end."""


def _make_tile(num_rows: int, num_panels: int) -> Callable[..., Any]:
    """A function that computes `x @ weight + bias` for `num_rows` rows and `num_panels` panels in registers."""

    @intrinsic
    def tile(typing_context, x, weight, bias, out, row, panel):
        signature = types.void(x, weight, bias, out, row, panel)

        def generate(context, builder, signature, arguments):
            x, weight, bias, out = (
                context.make_array(kind)(context, builder, value=value)
                for kind, value in zip(signature.args[:4], arguments[:4], strict=True)
            )
            row, panel = arguments[4:]
            number, integer = x.data.type.pointee, row.type
            num_bytes = context.get_abi_sizeof(number)
            vector = ir.VectorType(number, LANES)
            undefined = ir.Constant(vector, ir.Undefined)
            first_lane = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
            zero = ir.Constant(ir.IntType(32), 0)

            def offset(pointer, index):
                return builder.gep(pointer, [index])

            def row_of(array, index):
                stride = cgutils.unpack_tuple(builder, array.strides)[0]
                return offset(array.data, builder.mul(index, builder.sdiv(stride, integer(num_bytes))))

            def vector_at(pointer, index):
                return builder.bitcast(offset(pointer, index), vector.as_pointer())

            depth = cgutils.unpack_tuple(builder, x.shape)[1]
            rows = [builder.add(row, integer(index)) for index in range(num_rows)]
            panels = [builder.add(panel, integer(index)) for index in range(num_panels)]
            halves = [(index, integer(half * LANES)) for index in panels for half in range(2)]
            columns = [builder.add(builder.mul(index, integer(PANEL)), half) for index, half in halves]
            factors = [
                offset(weight.data, builder.add(builder.mul(builder.mul(index, depth), integer(PANEL)), half))
                for index, half in halves
            ]

            # Variables that only LLVM sees: it keeps them in registers throughout the loop.
            sums = [[cgutils.alloca_once(builder, vector) for _ in columns] for _ in rows]
            for index, column in enumerate(columns):
                start = builder.load(vector_at(bias.data, column), align=num_bytes)
                for row_sums in sums:
                    builder.store(start, row_sums[index])
            x_rows = [row_of(x, index) for index in rows]
            with cgutils.for_range(builder, depth) as loop:
                place = builder.mul(loop.index, integer(PANEL))
                weights = [builder.load(vector_at(pointer, place), align=num_bytes) for pointer in factors]
                for x_row, row_sums in zip(x_rows, sums, strict=True):
                    value = builder.insert_element(undefined, builder.load(offset(x_row, loop.index)), zero)
                    value = builder.shuffle_vector(value, undefined, first_lane)
                    for factor, total in zip(weights, row_sums, strict=True):
                        product = builder.fmul(value, factor, flags=["contract"])
                        builder.store(builder.fadd(product, builder.load(total), flags=["contract"]), total)
            for index, row_sums in zip(rows, sums, strict=True):
                out_row = row_of(out, index)
                for total, column in zip(row_sums, columns, strict=True):
                    builder.store(builder.load(total), vector_at(out_row, column), align=num_bytes)
            return context.get_dummy_value()

        return signature, generate

    return tile


# Ten sums of eight float32 fit the sixteen vector registers of AVX2, beside the factors.
_five_rows = _make_tile(5, 1)
_two_rows = _make_tile(2, 1)
_one_row = _make_tile(1, 1)
_one_row_two_panels = _make_tile(1, 2)


@compiled
def multiply_add(x: np.ndarray, weight: np.ndarray, bias: np.ndarray, out: np.ndarray) -> None:
    """Writes `x @ weight + bias` to `out`. Shapes are not checked.

    A row's result does not depend on the other rows.

    Args:
        x (`np.ndarray`):
            (R, K); its rows must be contiguous.
        weight (`np.ndarray`):
            Panels (P, K, `PANEL`), contiguous.
        bias (`np.ndarray`):
            (P * `PANEL`,), contiguous.
        out (`np.ndarray`):
            (R, P * `PANEL`) or wider; its rows must be contiguous.
    """
    num_rows, num_panels = x.shape[0], weight.shape[0]
    panel = 0
    if num_rows == 1:
        while panel + 2 <= num_panels:
            _one_row_two_panels(x, weight, bias, out, 0, panel)
            panel += 2
    while panel < num_panels:
        row = 0
        while row + 5 <= num_rows:
            _five_rows(x, weight, bias, out, row, panel)
            row += 5
        while row + 2 <= num_rows:
            _two_rows(x, weight, bias, out, row, panel)
            row += 2
        if row < num_rows:
            _one_row(x, weight, bias, out, row, panel)
        panel += 1
