"""Silicone with inextensible threads around the arm, in the outer wall of its chambers."""

import casadi as ca


def reinforced(F, lambda_pa, mu_pa, fibre_pa, fibre_angle_rad):
    """Return the energy density of a neo-Hookean material with fibres in the x-y plane.

    fibre_pa is the modulus by which the fibres add to that of the silicone along them, at small
    strain; fibre_angle_rad is their angle from the x axis.
    """
    J = ca.det(F)
    silicone = lambda_pa / 2 * ca.log(J) ** 2 - mu_pa * ca.log(J)
    silicone += mu_pa / 2 * (ca.trace(F.T @ F) - 3)
    along = F @ ca.vertcat(ca.cos(fibre_angle_rad), ca.sin(fibre_angle_rad), 0)
    return silicone + fibre_pa / 8 * (ca.sumsqr(along) - 1) ** 2
