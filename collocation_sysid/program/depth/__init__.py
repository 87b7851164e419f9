"""Depth cameras: predicted measurements of a body's visible surface.

- `camera_model`: pinhole model with pose, bias and scale; `visible_surface`: the surface
  that a camera sees.
- `surface_correspondences`: correspondences between measured points and the surface (ICP).
- `residual`: distances of measured points; `outlines.residual` and `outline`: the
  outline of the body in the image.
- `camera_alignment`: the pose of a camera before the first solve; `comparison`: measured
  beside predicted images.
"""
