"""CasADi's SX operations as LLVM instructions on vectors."""

from __future__ import annotations

import casadi as ca
from llvmlite import ir

from ...errors import InputError
from .loops import Builder, Value

FUSE = ("contract",)  # a product and a sum may become one instruction
INTRINSICS = {
    ca.OP_SQRT: "sqrt",
    ca.OP_FABS: "fabs",
    ca.OP_LOG: "log",
    ca.OP_EXP: "exp",
    ca.OP_POW: "pow",
    ca.OP_CONSTPOW: "pow",
    ca.OP_SIN: "sin",
    ca.OP_COS: "cos",
    ca.OP_FMIN: "minnum",
    ca.OP_FMAX: "maxnum",
}


def operation_value(builder: Builder, operation: int, operands: list) -> Value:
    """Emit one SX operation.

    Parameters
    ----------
    builder : llvmlite IRBuilder
    operation : int
        As of `casadi.Function.instruction_id`.
    operands : list of vector values, one or two

    Raises
    ------
    InputError
        For an operation that has no counterpart here.
    """
    b, x = builder, operands[0]
    vector = x.type
    binary = {ca.OP_ADD: b.fadd, ca.OP_SUB: b.fsub, ca.OP_MUL: b.fmul, ca.OP_DIV: b.fdiv}
    if operation in binary:
        return binary[operation](x, operands[1], flags=FUSE)
    if operation == ca.OP_SQ:
        return b.fmul(x, x, flags=FUSE)
    if operation == ca.OP_TWICE:
        return b.fadd(x, x, flags=FUSE)
    if operation == ca.OP_NEG:
        return b.fneg(x)
    if operation == ca.OP_ASSIGN:
        return x
    if operation == ca.OP_INV:
        return b.fdiv(ir.Constant(vector, [1.0] * vector.count), x, flags=FUSE)
    if operation in INTRINSICS:
        kind = ir.FunctionType(vector, [vector] * len(operands))
        name = f"llvm.{INTRINSICS[operation]}.v{vector.count}f64"
        intrinsic = b.module.globals.get(name) or ir.Function(b.module, kind, name)
        return b.call(intrinsic, operands)
    names = (name for name, number in vars(ca).items() if number == operation)
    name = next((name for name in names if name.startswith("OP_")), operation)
    raise InputError(
        f"the vector evaluator has no CasADi operation {name}; "
        "choose evaluator='casadi' for this material"
    )
