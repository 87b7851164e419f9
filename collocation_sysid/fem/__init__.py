"""Finite elements of a deformable body: meshes, materials, forces and their derivatives.

Bodies:

- `body`: a deformable body with internal forces and their derivatives; start here.
- `regions`: parts of a body with their own material, and the vector θ of all constants.
- `constants`: names, units, symbols and bounds of constants.
- `spatial_field`, `two_phase`: constants that vary in space.
- `rest_shape`, `rest_point_layout`: stress-free shape of a body that was scanned under gravity.
- `air`: buoyancy, added mass and drag of the surrounding air.

Meshes:

- `mesh`: tetrahedral mesh and nodes of the elements; `mesh_checks` validates it, `mesh_files` reads
  and writes files.
- `structured`: boxes and cylinders; `surface`: mesh of a closed surface; `refinement`: finer
meshes.
- `selection`: nodes, cells and faces by position, index or name.

Elements and laws:

- `elements`: shape functions, quadrature, mass lumping; `mean_dilatation`: averaged dilatation.
- `materials`: energies, damping laws and Prony branches; `moduli`: pairs of elastic constants.
- `memory`, `stress`: viscoelastic memory and the stresses at quadrature points.
- `node_force`, `force_points`, `contact_surface`: forces on nodes and faces, and contact points.
- `shape`: lengths and volumes as functions of node positions.

Assembly:

- `discretisation`: evaluators of all elements of a body; `expressions`, `kernel`: expressions of
one
  quadrature point; `kernels`: their evaluation over elements and time steps.
- `pattern`: sparsity patterns.
"""
