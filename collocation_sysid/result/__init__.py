"""Output of a finished run: files, reports on a terminal, web pages, pictures, films and exports.

Files: `record` writes a run folder, `replay` reads one back, `writers` writes ParaView frames and
replaces folders safely, `refined` adds measured discretisation errors to a run folder, and
`synthesis` writes simulated recordings.

Text: `run_sections` describes a run, `probe_sections` its probes, and `check_sections` the findings
of a check; `report` turns such sections into an HTML page or Markdown, and `progress` shows a solve
while it runs.

Pictures: the package `design_figures` has static figures in the look of `style`; `animation` makes
films,
`view` an interactive window, and `page` a web page with the moving body. `fit_summary` prepares the
points
of depth cameras for all of these, and `fields` evaluates stress and energy in each element.

Other simulators: the package `export` writes the identified body.
"""
