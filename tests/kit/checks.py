"""Comparison of derivatives with central differences, and orders of convergence."""

from collocation_sysid.testing.finite_differences import (
    assert_derivative,
    directional_derivative,
    observed_order,
    relative_error,
)

__all__ = ["assert_derivative", "directional_derivative", "observed_order", "relative_error"]
