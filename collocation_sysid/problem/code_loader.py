"""Code that a problem names: Python files with custom materials, forces, sensors and nuisance
parameters, and options of solvers that load libraries or start programs.

It is run only if the user allows it.
"""

from __future__ import annotations

import re
import runpy
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

from ..common.files import reason
from ..errors import InputError, hint_at, located
from ..fem.laws.materials import Energy, Material
from ..fem.node_force import NodeForce
from ..recording.deviation import Deviation
from ..recording.node_selection import selection_from_section
from .measurement_section import existing_file
from .nuisance_schema import CustomNuisanceSection
from .schema import CodeSection, NodeForceSection

# Options with which IPOPT loads a library or opens a file, and CasADi starts a compiler.
_CODE_OPTION = re.compile(r"lib$|file|jit|dump")
# Texts of CasADi's options: any other one may be a plugin, for which the working folder is searched.
_CASADI_TEXTS = {"piqp", "qrqp", "osqp", "qpoases", "daqp", "highs", "clp", "proxqp", "hpipm"}
_CASADI_TEXTS |= {"none", "regularize", "eigen-reflect", "eigen-clip"}


@dataclass(frozen=True)
class CodeLoader:
    """Loader of Python files, which runs them only if that is allowed."""

    folder: Path  # folder that contains the files
    is_allowed: bool  # whether files may be run

    def material(self, section: CodeSection, key: str) -> Material:
        """Return the custom material that a section names.

        Parameters
        ----------
        section : CodeSection
            File, and name of the energy function or of a `Material` in it.
        key : str
            Key of the section in the problem file, for messages.

        Returns
        -------
        Material
            The value itself if the file defines a `Material`, else one made from the energy
            function, named like the function.

        Raises
        ------
        InputError
            See `function`; also if the function is no energy density, see `Material.from_energy`.
        """
        file, loaded = self.function(section.file, section.function, f"{key}.file")
        if isinstance(loaded, Material):
            return loaded
        with located(file):
            return Material.from_energy(cast(Energy, loaded), section.function)

    def force(self, section: NodeForceSection, key: str) -> NodeForce:
        """Return the custom force on nodes or faces that a section names, on the section's nodes if
        it states some.

        A `NodeForce` that the file defines is used as it is, `on` of the section is then ignored; a
        function is the law of a new force with `on` and `carries` of the section.

        Parameters
        ----------
        section : NodeForceSection
            File, name and options of the force.
        key : str
            Key of the section in the problem file, for messages.

        Raises
        ------
        InputError
            See `function`; also if the function is no force, see `NodeForce.from_law`, or if
            `carries` is stated and differs from that of a `NodeForce`.
        """
        file, loaded = self.function(section.file, section.function, f"{key}.file")
        nodes = None if section.nodes is None else selection_from_section(section.nodes)
        name = section.function
        carries = section.carries
        if isinstance(loaded, NodeForce):
            if carries not in (0, loaded.internal_variable_count):
                message = (
                    f"found {carries}, but the force {name!r} has "
                    f"{loaded.internal_variable_count} internal variables; expected no carries: omit "
                    "this key"
                )
                raise InputError(message, where=f"{key}.carries")
            return loaded if nodes is None else replace(loaded, nodes=nodes)
        with located(file):
            return NodeForce.from_law(
                loaded, nodes=nodes, name=name, on=section.on, carries=carries
            )

    def nuisance_row(self, section: CustomNuisanceSection) -> Deviation:
        """Return the `Deviation` that a Python file defines under the name `row` of the section;
        see `function` for the errors.
        """

        def is_row(value: Any) -> bool:
            return isinstance(value, Deviation)

        key = "nuisance.own.file"
        return self._load(section.file, section.row, key, "Deviation", is_row)[1]

    def function(self, file: str, name: str, key: str) -> tuple[Path, Callable[..., Any]]:
        """Run a Python file, and return its path and the function in it that has a name.

        Any callable and any `NodeForce` count as functions. The file is run in every call.

        Parameters
        ----------
        file : str
            Name of the file, relative to the folder of the problem.
        key : str
            Key of the problem file that names the file, for messages.

        Raises
        ------
        InputError
            If running code is not allowed, the file or the function does not exist, the name
            belongs to something else, or the file fails.
        """

        def is_function(value: Any) -> bool:
            return callable(value) or isinstance(value, NodeForce)

        return self._load(file, name, key=key, kind="function", is_kind=is_function)

    def require_harmless(self, name: str, method: object) -> None:
        """Refuse options of IPOPT and of CasADi by which the table of a method, by its name, could
        run code, unless running code is allowed.

        Raises
        ------
        InputError
            For the first option of that kind; its location is the table of the options.
        """
        if self.is_allowed:
            return
        for table in ("ipopt", "casadi"):
            option = next(_code_options(getattr(method, table, {}), table), None)
            if option is not None:
                message = (
                    f"found {option}, with which a solver may load or write a file, or start a "
                    "program; allow that with --allow-code (allow_code=True from Python) if "
                    "you trust the file"
                )
                raise InputError(message, where=f"solver.{name}.{table}")

    def _load(
        self, name: str, value_name: str, key: str, kind: str, is_kind: Callable[[Any], bool]
    ) -> tuple[Path, Any]:
        """Run a file in every call, and return its path and the value with a name."""
        if not self.is_allowed:
            message = (
                f"found the file {name}, which would be run as Python code; allow that with "
                "--allow-code (allow_code=True from Python) if you trust it"
            )
            raise InputError(message, where=key.rpartition(".")[0])
        file = existing_file(self.folder, name, key=key)
        try:
            names = runpy.run_path(str(file))
        except (Exception, SystemExit) as error:
            raise InputError(
                f"this Python file raised an error when it was run: {reason(error)}", file
            ) from error
        if not is_kind(names.get(value_name)):
            known_names = [
                n for n, value in names.items() if is_kind(value) and not n.startswith("_")
            ]
            known = f"{', '.join(known_names) or 'none'}{hint_at(value_name, known_names)}"
            raise InputError(f"there is no {kind} {value_name!r}; expected one of {known}", file)
        return file, names[value_name]


def _code_options(options: Mapping[str, Any], table: str) -> Iterator[str]:
    """Yield the names of options that may run code, also in tables within the options."""
    for name, value in options.items():
        if isinstance(value, Mapping):
            yield from (f"{name}.{inner}" for inner in _code_options(value, table))
        elif _CODE_OPTION.search(name) or (
            table == "casadi"
            and not isinstance(value, int | float)
            and str(value) not in _CASADI_TEXTS
        ):
            yield name
