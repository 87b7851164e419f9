"""Output of a finished run: files, text on a terminal, reports, pictures and films.

Files: `run_record` writes a run folder, `replay` reads one back, `run_writers` writes ParaView
frames and replaces folders safely, `run_refinement` adds measured discretisation errors to a run
folder, and `synthesis` writes simulated recordings.

Text: `run_sections` describes a run, and `check_sections` the findings
of a check; `report` turns such sections into an HTML page or Markdown, `picture_captions` adds the
pictures, and `solve_progress` shows a solve while it runs.

Pictures: the package `pictures` has static figures in the look of `figure_style`; `animation` makes
films, `frame_fields` reads the stress of ParaView frames on the surface. `camera_overlays` prepares
the points of cameras for all of these, and `element_fields` evaluates stress and energy in
each element.
"""
