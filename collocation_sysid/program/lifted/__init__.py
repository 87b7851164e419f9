"""Variables that are eliminated by default and can be kept, with equations of their own.

Interior-point methods and the methods for comparison keep them, because the sparse program then
has simpler equations; reduced space eliminates them.

- `lifted_collocation`: the program with these variables, and its groups of variables;
  `lifted_variables`: their base class.
- `lifted_memory`: internal variables of viscoelastic materials; `lifted_force_histories`: those of
  forces with a history.
- `lifted_pressures`: pressures with complementarity conditions.
- `lifted_reactions`, `lifted_resultants`: reactions of grasps and their measured resultants.
- `expression_patterns`: constraints that repeat one small expression.
"""
