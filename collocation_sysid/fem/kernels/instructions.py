"""CasADi's SX operations as LLVM instructions on vectors.

Comparisons and logical operations give 1 or 0, and any number except 0 is true. Operations without
a vector instruction in LLVM call the C library lane by lane, as CasADi's virtual machine does.

The C library has no inverse error function. Here it consists of elementary operations: a rational
initial guess and two Newton steps, which are exact up to the rounding of x. CasADi's function has
errors of up to 3·10⁻⁶, mostly around |x| = 0.7.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import casadi as ca
from llvmlite import ir

from .batch import VectorCodeError
from .jit import DOUBLE, I32, Builder, Value

# Numerator and denominator of the initial guess of the inverse error function, for |x| < 0.7 and
# beyond; the highest power first.
CENTRE = (
    (-0.140543331, 0.914624893, -1.645349621, 0.886226899),
    (0.012229801, -0.329097515, 1.442710462, -2.118377725, 1.0),
)
# The same for larger |x|, in powers of √(−ln((1 − |x|)/2)).
TAIL = ((1.641345311, 3.429567803, -1.624906493, -1.970840454), (1.637067800, 3.543889200, 1.0))


def _inverse_error(x: ca.SX) -> ca.SX:
    """Return the inverse error function of x as an expression: ±∞ at ±1, NaN beyond."""
    away_from_zero = _ratio(TAIL, ca.sqrt(-ca.log((1 - ca.fabs(x)) / 2)))
    y = ca.if_else(ca.fabs(x) < 0.7, x * _ratio(CENTRE, x**2), ca.copysign(away_from_zero, x))
    for _ in range(2):
        slope = 2 / math.sqrt(math.pi) * ca.exp(-(y**2))
        y -= (ca.erf(y) - x) / slope
    # At ±1 the slope is zero; beyond, the logarithm has made NaN of it.
    return ca.if_else(ca.fabs(x) == 1, x * math.inf, y)


def _ratio(coefficients: tuple[tuple[float, ...], ...], z: ca.SX) -> ca.SX:
    """Return the ratio of two polynomials at z, the highest power first."""
    numerator, denominator = (ca.polyval(ca.SX(part), z) for part in coefficients)
    return numerator / denominator


_X = ca.SX.sym("x")
ERFINV = ca.Function("erfinv", [_X], [_inverse_error(_X)])


FUSE = ("contract",)  # a product and a sum may become one instruction
Emit = Callable[..., Value]  # of the builder and one or two operands


def emit_function(
    builder: Builder,
    function: ca.Function,
    vector: ir.VectorType,
    read: Callable[[int, int], Value],
) -> Iterator[tuple[int, int, Value]]:
    """Emit an SX function, one operation after the other.

    Parameters
    ----------
    read : callable
        Returns the value of (input, entry).

    Yields
    ------
    output, entry : int
        Index of the output, and index of its entry.
    value : llvmlite value
        Vector value of the entry.

    Raises
    ------
    VectorCodeError
        For an operation that vector code does not support.
    """
    require_supported_operations(function)
    work: dict[int, Value] = {}
    for k in range(function.n_instructions()):
        operation = function.instruction_id(k)
        source = function.instruction_input(k)
        target = function.instruction_output(k)
        if operation == ca.OP_INPUT:
            work[target[0]] = read(*source)
        elif operation == ca.OP_CONST:
            work[target[0]] = _constant(vector, function.instruction_constant(k))
        elif operation == ca.OP_OUTPUT:
            yield target[0], target[1], work[source[0]]
        else:
            work[target[0]] = OPERATIONS[operation](builder, *(work[i] for i in source))


def require_supported_operations(function: ca.Function) -> None:
    """Raise a `VectorCodeError` with their names if a function has operations without
    instructions.
    """
    known = {ca.OP_INPUT, ca.OP_CONST, ca.OP_OUTPUT, *OPERATIONS}
    operations = {function.instruction_id(k) for k in range(function.n_instructions())}
    if missing := sorted(operations - known):
        raise VectorCodeError(
            f"vector code has no CasADi operation {', '.join(map(operation_name, missing))}"
        )


def operation_name(operation: int) -> str:
    """Return the name of an operation in CasADi, such as "OP_ADD"."""
    names = (name for name, number in vars(ca).items() if number == operation)
    return next((name for name in names if name.startswith("OP_")), str(operation))


# Ways to emit one operation --------------------------------------------------------------------


def _constant(vector: ir.VectorType, value: float) -> Value:
    """Return a vector of equal constants."""
    return ir.Constant(vector, [float(value)] * vector.count)


def _emit_intrinsic(name: str) -> Emit:
    """Return the emitter of a vector intrinsic of LLVM."""

    def emit(b: Builder, *operands: Value) -> Value:
        """Emit the call of the intrinsic."""
        vector = operands[0].type
        full_name = f"llvm.{name}.v{vector.count}f64"
        return b.call(_declare(b.module, full_name, kind=vector, operands=len(operands)), operands)

    return emit


def _emit_library_call(name: str) -> Emit:
    """Return the emitter of a function of the C library, called lane by lane."""

    def emit(b: Builder, *operands: Value) -> Value:
        """Emit a call for each lane."""
        function = _declare(b.module, name, kind=DOUBLE, operands=len(operands))
        # Otherwise a call may set errno, and the compiler keeps even those that are repeated.
        function.attributes.add("readnone")
        result: Value = ir.Constant(operands[0].type, ir.Undefined)
        for lane in map(I32, range(operands[0].type.count)):
            scalars = [b.extract_element(operand, lane) for operand in operands]
            result = b.insert_element(result, b.call(function, scalars), lane)
        return result

    return emit


def _declare(module: ir.Module, name: str, kind: ir.Type, operands: int) -> ir.Function:
    """Return a declared function, with results and `operands` arguments of one kind."""
    declared = module.globals.get(name)
    return declared or ir.Function(module, ir.FunctionType(kind, [kind] * operands), name)


def _emit_comparison(sign: str) -> Emit:
    """Return the emitter of a comparison, with the values 1 and 0."""

    def emit(b: Builder, x: Value, y: Value) -> Value:
        return b.uitofp(_comparison(b, sign, x, y), x.type)

    return emit


def _comparison(b: Builder, sign: str, x: Value, y: Value) -> Value:
    """Return a vector of booleans; as in C, NaN differs from everything."""
    return (b.fcmp_unordered if sign == "!=" else b.fcmp_ordered)(sign, x, y)


def _is_true(b: Builder, x: Value) -> Value:
    """Return whether values are nonzero, as a vector of booleans."""
    return _comparison(b, "!=", x, _constant(x.type, 0.0))


def _sign(b: Builder, x: Value) -> Value:
    """Emit the sign of x; zeros of either sign and NaN are unchanged."""
    zero, one, minus_one = (_constant(x.type, value) for value in (0.0, 1.0, -1.0))
    # Zeros of either sign and NaN are their own sign.
    positive = b.select(_comparison(b, ">", x, zero), one, x)
    return b.select(_comparison(b, "<", x, zero), minus_one, positive)


def _erfinv(b: Builder, x: Value) -> Value:
    """Emit the inverse error function."""
    ((_, _, value),) = emit_function(b, ERFINV, vector=x.type, read=lambda *_: x)
    return value


INTRINSICS = {
    ca.OP_SQRT: "sqrt",
    ca.OP_FABS: "fabs",
    ca.OP_FLOOR: "floor",
    ca.OP_CEIL: "ceil",
    ca.OP_COPYSIGN: "copysign",
    ca.OP_LOG: "log",
    ca.OP_EXP: "exp",
    ca.OP_POW: "pow",
    ca.OP_CONSTPOW: "pow",
    ca.OP_SIN: "sin",
    ca.OP_COS: "cos",
    ca.OP_FMIN: "minnum",
    ca.OP_FMAX: "maxnum",
}
LIBRARY = {
    ca.OP_TAN: "tan",
    ca.OP_ASIN: "asin",
    ca.OP_ACOS: "acos",
    ca.OP_ATAN: "atan",
    ca.OP_ATAN2: "atan2",
    ca.OP_SINH: "sinh",
    ca.OP_COSH: "cosh",
    ca.OP_TANH: "tanh",
    ca.OP_ASINH: "asinh",
    ca.OP_ACOSH: "acosh",
    ca.OP_ATANH: "atanh",
    ca.OP_LOG1P: "log1p",
    ca.OP_EXPM1: "expm1",
    ca.OP_ERF: "erf",
    ca.OP_HYPOT: "hypot",
    ca.OP_FMOD: "fmod",
    ca.OP_REMAINDER: "remainder",
}
COMPARISONS = {ca.OP_LT: "<", ca.OP_LE: "<=", ca.OP_EQ: "==", ca.OP_NE: "!="}
OPERATIONS: dict[int, Emit] = {
    ca.OP_ASSIGN: lambda b, x: x,
    ca.OP_ADD: lambda b, x, y: b.fadd(x, y, flags=FUSE),
    ca.OP_SUB: lambda b, x, y: b.fsub(x, y, flags=FUSE),
    ca.OP_MUL: lambda b, x, y: b.fmul(x, y, flags=FUSE),
    ca.OP_DIV: lambda b, x, y: b.fdiv(x, y, flags=FUSE),
    ca.OP_NEG: lambda b, x: b.fneg(x),
    ca.OP_SQ: lambda b, x: b.fmul(x, x, flags=FUSE),
    ca.OP_TWICE: lambda b, x: b.fadd(x, x, flags=FUSE),
    ca.OP_INV: lambda b, x: b.fdiv(_constant(x.type, 1.0), x, flags=FUSE),
    ca.OP_NOT: lambda b, x: b.uitofp(b.not_(_is_true(b, x)), x.type),
    ca.OP_AND: lambda b, x, y: b.uitofp(b.and_(_is_true(b, x), _is_true(b, y)), x.type),
    ca.OP_OR: lambda b, x, y: b.uitofp(b.or_(_is_true(b, x), _is_true(b, y)), x.type),
    # Not a product: the branch that is not taken may be infinite or NaN.
    ca.OP_IF_ELSE_ZERO: lambda b, x, y: b.select(_is_true(b, x), y, _constant(y.type, 0.0)),
    ca.OP_SIGN: _sign,
    ca.OP_ERFINV: _erfinv,
    **{operation: _emit_comparison(sign) for operation, sign in COMPARISONS.items()},
    **{operation: _emit_intrinsic(name) for operation, name in INTRINSICS.items()},
    **{operation: _emit_library_call(name) for operation, name in LIBRARY.items()},
}
