"""Problems of the catalogue of identified materials, with source and licence of the data."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]


@dataclass(frozen=True)
class CatalogueSource:
    """One problem of the catalogue."""

    name: str  # name of the entry, unique
    problem: str  # problem file, relative to the repository
    specimen: str  # the recorded body and its test, in words
    source: str  # who recorded or simulated the data, and where they are published
    licence: str  # licence of the recordings
    # Module of `scripts/data` that simulated the recordings and has their constants as `TRUTH`;
    # empty for measured data.
    twin_script: str = ""
    # Whether the samples of a static recording have the times of the test, so that a strain rate
    # follows from them.
    static_times_are_recorded: bool = False
    # Whether the solve takes longer than ten minutes, so that it is left out by default.
    is_long: bool = False

    @property
    def is_measured(self) -> bool:
        """Whether the recordings are measurements."""
        return not self.twin_script

    @property
    def problem_file(self) -> Path:
        """Absolute path of the problem file."""
        return ROOT / self.problem


BEAM = (
    "Dubied et al. 2022, Soft Robotics Lab, ETH Zürich, arXiv 2201.12560; "
    "repository srl-ethz/diffPD_sim2real"
)
PHANTOMS = "Dawood et al. 2026; repository abubakardawood/tissue-phantom-material-database"
BARS = "Arnavaz et al. 2023, Computer Graphics Forum 42(1); repository diku-dk/DiffCal"
TENTACLE = "SoRoMoX contributors, TU Delft; repository tud-phi/soromox"
RUBBER = "numbers from Hyperelastics.jl (TRACER Lab at Liberty University)"
GPL = "GPL-3.0"
CC_BY = "CC BY 4.0"
MIT = "MIT"
OWN = "this project"


def _twin(name: str, specimen: str, file: str = "problem") -> CatalogueSource:
    problem = f"problems/{name}/{file}.toml"
    return CatalogueSource(f"twin_{name}", problem, specimen, OWN, MIT, f"make_{name}")


def _specimen(name: str, file: str, specimen: str, *, is_long: bool = False) -> CatalogueSource:
    problem = f"problems/phantom_compression/{file}.toml"
    return CatalogueSource(
        name, problem, specimen, PHANTOMS, CC_BY, static_times_are_recorded=True, is_long=is_long
    )


SOURCES = (
    _specimen(
        "ecoflex_00_30_sticking",
        "problem",
        "Ecoflex 00-30, cylinder compressed between sticking platens",
    ),
    _specimen(
        "ecoflex_00_30_lubricated",
        "sliding",
        "Ecoflex 00-30, the same loads, platens assumed to be lubricated",
    ),
    _specimen(
        "ecoflex_00_30_whole_stroke",
        "whole_stroke",
        "Ecoflex 00-30, cylinder compressed to a third of its height, with contact",
        is_long=True,
    ),
    CatalogueSource(
        "ecoflex_00_50_bar",
        "problems/silicone_depth/ecoflex.toml",
        "Ecoflex 00-50, hanging bar in one depth image",
        BARS,
        GPL,
    ),
    CatalogueSource(
        "mold_star_15_bar",
        "problems/silicone_depth/mold_star.toml",
        "Mold Star 15, hanging bar in one depth image",
        BARS,
        GPL,
    ),
    CatalogueSource(
        "ecoflex_mold_star_bar",
        "problems/silicone_depth/halves_hanging.toml",
        "bar of Ecoflex 00-50 and Mold Star 15, hanging, in one depth image",
        BARS,
        GPL,
    ),
    CatalogueSource(
        "dragon_skin_10_beam",
        "problems/srl_beam/problem.toml",
        "Dragon Skin 10, clamped beam released at its tip, motion capture",
        BEAM,
        MIT,
    ),
    CatalogueSource(
        "dragon_skin_10_beam_memory",
        "problems/srl_beam/memory.toml",
        "Dragon Skin 10, the same recordings with one branch of memory",
        BEAM,
        MIT,
    ),
    CatalogueSource(
        "silicone_tentacle",
        "problems/soft_tentacle/problem.toml",
        "silicone tentacle bent by tendons, motion capture of equilibria",
        TENTACLE,
        MIT,
    ),
    CatalogueSource(
        "isoprene_rubber",
        "collocation_sysid/datasets/kawabata_1981/problem.toml",
        "isoprene rubber vulcanisate, uniaxial, equibiaxial and planar tension",
        f"Kawabata et al. 1981, Macromolecules 14(1); {RUBBER}",
        MIT,
    ),
    CatalogueSource(
        "vulcanised_rubber",
        "collocation_sysid/datasets/treloar_1944/problem.toml",
        "vulcanised rubber (8 % S), uniaxial tension at 20 °C",
        f"Treloar 1944, Rubber Chemistry and Technology 17(4); {RUBBER}",
        MIT,
    ),
    CatalogueSource(
        "calendered_rubber",
        "collocation_sysid/datasets/diani/problem.toml",
        "calendered rubber, uniaxial tension along calendering",
        f"Diani and co-workers; {RUBBER}",
        MIT,
    ),
    _twin("foam_cylinder", "foam cylinder swung by a robot, marker positions unknown", "recording"),
    _twin("noisy_cylinder", "foam cylinder with lost, exchanged and misplaced markers"),
    _twin("table1", "cylinder of Table I of the paper, data without noise"),
    _twin("wrist_sensor", "foam block of unknown density, hand with a force sensor"),
    _twin("laid_block", "foam block that a gripper places on a plate"),
    _twin("poked_block", "gel block poked by a ball at twelve places, force only"),
)
