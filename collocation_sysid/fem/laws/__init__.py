"""Constitutive laws: constants, energies, stresses, damping and memory.

- `constants`: names, units, symbols and bounds of constants; `moduli`: pairs of elastic constants.
- `materials`: energies, damping laws and Prony branches; `ogden`: Ogden's law and hyperelastic
  foam.
- `invariants`, `power_traces`: invariants of C and traces of its powers.
- `stress`, `memory`: stresses and viscoelastic memory at quadrature points; `mean_dilatation`:
  averaged dilatation of nearly incompressible elements.
- `damping_admissibility`: refusal of user-defined damping laws.
"""
