"""Reading of material tests without a mesh: a table and its file become a static `Experiment`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..common.array_types import Array, Index
from ..common.time_dependence import at_times, values_over_time
from ..errors import InputError, listed, located
from ..fem.body import Body
from ..recording import Experiment, Specimen
from ..recording.specimen_averages import RESOLUTION, with_averaged_rows
from ..recording.specimen_checks import (
    loading_rows,
    order_warnings,
    require_plausible_specimen,
    rows_after_cycles,
)
from ..recording.specimen_files import SpecimenLayout, SpecimenTable, read_specimen
from .measurement_section import existing_file
from .specimen_schema import SpecimenSection, deviation

# Strain of the first sample, over the largest, above which a memory's unknown past matters.
UNKNOWN_PAST = 0.05


@dataclass
class SpecimenReader:
    """Reader of one material test."""

    section: SpecimenSection  # table of the experiment
    folder: Path  # folder that contains the file
    body: Body  # homogeneous cell of the test
    simulation: bool = False  # whether the problem is simulated: then every row is used
    # Assumptions that were made; reading adds to them.
    notes: list[str] = field(default_factory=list)

    def read(self) -> tuple[Specimen, Experiment]:
        """Read the file; return the measurements, and the static experiment of the homogeneous
        cell.

        Notes are added to `notes`, each with the experiment's name in front.

        Raises
        ------
        InputError
            Names the file and line, or the key within the experiment's table; also for stretches or
            stresses that are implausible.
        """
        section = self.section
        file = existing_file(self.folder, section.file, key="file")
        has_order = section.modulus == "relaxation" or self.body.has_memory
        layout = layout_from_section(
            section, requires_times=has_order and section.modulus != "harmonic"
        )
        table = read_specimen(file, replace(layout, window_s=None) if self.simulation else layout)
        for note in table.notes:
            self._add_note(f"{section.file}: {note}")
        if {"second_displacement", "second_force"} & set(table.columns):
            self._add_note(
                "both displacements are divided by length_m, both forces by area_m2: of a specimen "
                "with two sizes, convert them to strains and stresses"
            )
        if table.is_incompressible:
            what = (
                "the difference of the true stresses is taken"
                if section.test == "biaxial-difference"
                else "true stresses were converted to engineering stresses"
            )
            self._add_note(
                f"{what} as if the material was incompressible, because the file has no lateral "
                "stretch; a lateral stretch would be used instead"
            )
        if table.unread:
            which = "this column is" if len(table.unread) == 1 else "these columns are"
            self._add_note(f"{section.file}: {which} not read: {', '.join(table.unread)}")
        specimen = self._specimen(table)
        deformation = replace(specimen.find_deformation(), columns=table.columns)
        with located(file):
            require_plausible_specimen(
                specimen, is_stretch=not {"stretch", "volume_ratio"}.isdisjoint(table.columns)
            )
            if table.compressive and specimen.strain.max() > -specimen.strain.min():
                raise InputError(
                    f"the name of {listed([repr(each) for each in table.compressive])} states "
                    "compression, and its values are read as tension: state strain_sign = -1 and "
                    "stress_sign = -1 where compression is positive"
                )
        if not section.modulus:
            for warning in order_warnings(specimen):
                self._add_note(warning)
        if table.is_displacement and section.area_m2 is None:
            self._add_note(
                "the compliance of the test bench is not part of the budget: state area_m2, the "
                "undeformed area of the specimen, unless an extensometer measured the displacement"
            )
        if deformation.is_displacement and deformation.lateral and specimen.strain.max() > 0:
            self._add_note(
                f"length_m = {section.length_m:g} is the length that is stretched: between the grips "
                "of a strip, but of a dogbone the effective length of its narrow part, because the "
                "shoulders hardly stretch (10 to 30 % less is common). The entry effective_length of "
                '[uncertainty.assumptions] contains 15 %; state "none" for an extensometer or a strip'
            )
        self._note_unknown_past(specimen)
        fitted = specimen
        if not (self.simulation or section.validation or self.body.has_memory):
            fitted = with_averaged_rows(specimen)
        if fitted is not specimen:
            self._add_note(
                f"{section.file}: {len(specimen.strain)} rows are averaged to {len(fitted.strain)}, "
                f"while the strain changes by less than {RESOLUTION:.0%} of its range"
            )
        experiment = fitted.experiment(
            name=section.name, validation=section.validation, body=self.body
        )
        return specimen, replace(experiment, specimen=deformation)

    def _add_note(self, note: str) -> None:
        self.notes.append(f"experiment '{self.section.name}': {note}")

    def _specimen(self, table: SpecimenTable) -> Specimen:
        section = self.section
        rows = self._rows(table)
        if len(rows) < table.row_count:
            self._add_note(f"{section.file}: {len(rows)} of {table.row_count} rows are used")
        arguments = values_over_time(at_times(table, rows))
        temperature = {
            "shift": section.shift,
            "temperature_difference_k": section.temperature_difference_k,
        }
        errors: dict[str, Any] = {
            "area_error": deviation(section.area_error),
            "specimen": section.specimen,
            "specimen_stiffness": section.specimen_stiffness,
        }
        if section.modulus == "harmonic":
            assert section.relative_sigma is not None
            specimen = Specimen.harmonic(
                arguments["frequency_hz"],
                arguments["stress_pa"],
                arguments["loss_pa"],
                section.relative_sigma,
                section.deformation,
                **temperature,
            )
            return replace(specimen, **errors)
        del arguments["frequency_hz"], arguments["loss_pa"]
        if section.modulus == "relaxation":
            sigma = arguments["sigma_pa"]
            specimen = Specimen.relaxation(
                arguments["t_s"],
                arguments["stress_pa"],
                self._sigma_pa() if sigma is None else sigma,
                section.deformation,
                **temperature,
            )
            return replace(specimen, **errors)
        arguments |= dict.fromkeys(self._placeholders(arguments))
        if arguments["sigma_pa"] is None:
            arguments["sigma_pa"] = self._sigma_pa()
        if arguments["lateral_sigma"] is None:
            arguments["lateral_sigma"] = section.lateral_sigma
        if section.length_m and section.area_m2:  # also of strains, which may be those of the grips
            arguments |= {"length_m": section.length_m, "area_m2": section.area_m2}
        return Specimen(
            section.test,
            **arguments,
            axial_stretch=section.axial_stretch,
            transverse_stretch=section.transverse_stretch,
            cut_angle_deg=section.cut_angle_deg,
            strain_zero=deviation(section.strain_zero),
            **errors,
            stress_zero_pa=deviation(section.stress_zero_pa),
            **temperature,
        )

    def _placeholders(self, arguments: Mapping[str, Array | None]) -> list[str]:
        """Return measurements that are all 0, or constant in a test of several strains."""
        names = []
        strain = arguments["strain"]
        is_varied = strain is not None and np.ptp(strain) > 0
        for name, what, is_impossible in (
            ("second_stress_pa", "second stresses", self.section.test == "planar"),
            ("lateral_stretch", "lateral stretches", True),
        ):
            values = arguments[name]
            known = np.zeros(0) if values is None else values[np.isfinite(values)]
            # A lateral stretch of exactly one is that of cork, or a placeholder, which a fit shows.
            is_constant = known.size > 2 and not np.ptp(known) and is_varied and known[0] != 1
            if is_impossible and known.size and (is_constant or not known.any()):
                names.append(name)
                self._add_note(
                    f"all {known.size} {what} in {self.section.file} are {known[0]:g}, which is "
                    f"impossible in a {self.section.test} test: they are taken as not measured"
                )
        return names

    def _rows(self, table: SpecimenTable) -> Index:
        """Return the indices (k,) of the rows to use; all rows of a simulation.

        Otherwise these are the rows of the table, thus of `window_s`, without the first
        `skip_cycles` cycles of the strain and, with branch "loading", only those of the last cycle
        up to its peak; of these every `every`-th row, beginning with the first one.
        """
        section = self.section
        rows = np.arange(len(table.t_s))
        if self.simulation:
            return rows
        if section.skip_cycles:
            rows = rows[rows_after_cycles(table.strain[rows], section.skip_cycles)]
        if section.branch == "loading":
            rows = rows[loading_rows(table.strain[rows])]
        return rows[:: section.every]

    def _sigma_pa(self) -> float:
        """The schema requires the σ of stress, or that of force and the undeformed area."""
        section = self.section
        if isinstance(section.sigma_pa, float):
            return section.sigma_pa
        assert isinstance(section.sigma_n, float)
        assert section.area_m2 is not None
        return section.sigma_n / section.area_m2

    def _note_unknown_past(self, specimen: Specimen) -> None:
        """A material with memory whose first strain exceeds `UNKNOWN_PAST` has an unknown past."""
        strain: Array = np.abs(specimen.strain)
        if self.body.has_memory and strain[0] > UNKNOWN_PAST * strain.max():
            self._add_note(
                f"the strain of the first sample is {specimen.strain[0]:.3g}, and the model assumes "
                "that the material has relaxed completely in this state; expected samples from the "
                "unloaded state on"
            )


def layout_from_section(
    section: SpecimenSection, *, requires_times: bool = False
) -> SpecimenLayout:
    """Return the meaning of the columns of the file of a specimen; `requires_times` is whether the
    file must contain times that increase.
    """
    return SpecimenLayout(
        test=section.deformation,
        modulus=section.modulus,
        noise_columns=section.noise_columns,
        columns=section.columns,
        strain_sign=section.strain_sign,
        stress_sign=section.stress_sign,
        stress=section.stress,
        length_m=section.length_m,
        area_m2=section.area_m2,
        requires_times=requires_times,
        header_line=section.header_line,
        window_s=section.window_s,
        axial_stretch=section.axial_stretch,
        transverse_stretch=section.transverse_stretch,
    )
