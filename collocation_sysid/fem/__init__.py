"""Finite elements of a deformable body: meshes, materials, forces and their derivatives.

Bodies:

- `body`: a deformable body with internal forces and their derivatives; start here.
- `coarse_body`: the same body on a coarser mesh, for the start of a search.
- `regions`: parts of a body with their own material, and the vector θ of all constants.
- `spatial_field`: constants that vary in space.
- `rest_shape`, `rest_point_layout`: stress-free shape of a body that was scanned under gravity.

Packages:

- `meshes`: construction, checks, files and selections of tetrahedral meshes.
- `laws`: constants, energies, stresses, damping and viscoelastic memory.
- `kernels`: compiled evaluation over elements and time steps.

Elements and forces:

- `elements`: shape functions, quadrature, mass lumping.
- `node_force`, `force_points`, `contact_surface`: forces on nodes and faces, such as
  those of the air, and contact points.
- `shape`: lengths and volumes as functions of node positions.

Assembly:

- `discretisation`: evaluators of all elements of a body; `expressions`, `kernel`: expressions of
  one
  quadrature point; `chain_rule`: derivatives of energies by invariants.
- `pattern`: sparsity patterns.

Time steps:

- `schemes`: time-stepping schemes as tables; `step_function`: one step as a CasADi expression.
"""
