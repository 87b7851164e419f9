"""General modules without mathematics, which all packages use and which import no package.

- `validated_classes`, `declarations`, `schema_tables`, `validated_types`, `field_descriptions`:
  classes that users state in Python or in a problem file, their checks and descriptions.
- `time_dependence`: fields that depend on time, their selection and interpolation.
- `files`, `array_files`, `written_files`: reading and writing of files, completely or not at all.
- `serialisation`: results as JSON; `display`: output as text, HTML and Markdown, in the
  terminal too; `pages`: pages of the documentation.
- `starting`, `signal_handling`, `isolated_process`: interrupts, and work in a process of its own.
- `step_counting`: progress of long operations; `limits`: memory and time; `cluster`: Dask.
- `array_types`: array types for annotations.
"""
