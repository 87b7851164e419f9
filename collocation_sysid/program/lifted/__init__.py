"""Variables that are eliminated by default and can be kept, with equations of their own.

Interior-point methods and the methods for comparison keep them, because the sparse program then
has simpler equations; reduced space eliminates them.

- `collocation`: the program with these variables, and its groups of variables;
  `variables`: their base class.
- `memory`: internal variables of viscoelastic materials; `force_histories`: those of
  forces with a history.
- `pressures`: pressures with complementarity conditions.
- `reactions`, `resultants`: reactions of grasps and their measured resultants.
- `expression_patterns`: constraints that repeat one small expression.
"""
