"""Public collections of measured and simulated data, downloaded when they are first used.

Nothing of them is part of the package. pooch compares the files with their checksums and keeps them
in the folder of `data_folder`.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from ..common.validated_classes import validated
from ..errors import InputError, require_among
from ..fem.kernels.jit import cache_folder
from .files import DATASETS, dataset_folder

HOST = "https://github.com"
INSTALLATION = "pip install 'collocation-sysid[datasets]'"


@dataclass(frozen=True)
class PublicCollection:
    """Files of a commit of a public repository on GitHub.

    `files` has the SHA-256 checksum of each path in the repository; a file whose checksum is not
    known (None) is not downloaded.
    """

    repository: str
    commit: str
    licence: str
    citation: str
    files: dict[str, str | None]

    def url(self, path: str) -> str:
        """Return the address of a file."""
        return f"{HOST}/{self.repository}/raw/{self.commit}/{path}"


_PLATES = "fenicsx/data/experiment_unsupervised11_"
COLLECTIONS = {
    "hyperelastic_curves": PublicCollection(
        "Chongran-Zhao/Calibration-Hyperelasticity",
        "1df0f5db970624f4b6efa7ae80f2ecef5580e9bd",
        licence="MIT",
        citation="the paper of each curve, which `hyperelastic_curves` lists",
        files={"data/data.h5": None},
    ),
    "plate_fingerprint": PublicCollection(
        "Material-Fingerprinting/material-fingerprinting-hyperelasticity",
        "af8d0fe",
        licence="MIT",
        citation="M. Flaschel, D. Martonová, C. Veil, E. Kuhl, Material Fingerprinting: A shortcut "
        "to material model discovery without solving optimization problems (2025)",
        files={
            "fenicsx/gmsh/plate_with_corner_hole_5e-2_triangle.msh": (
                "6f77452619123093f698c0349e3536cbab7dcee52335755a8722fd6771093e65"
            ),
            f"{_PLATES}NeoHooke_noise0.0.npz": (
                "c3ac07fc77ee2a2ebf6522a31e49222774b8e32be4656e2c6cf6622dede871d4"
            ),
            f"{_PLATES}NeoHooke_noise0.01.npz": (
                "02a8c39ddf3b620c31d4aab1b8ba1b9a79583bc2d07205b3ae0057031abdd419"
            ),
            f"{_PLATES}MooneyRivlin_noise0.0.npz": (
                "253749efa59ceac751bbddd604db9f9b62f5d02044f7ccad7a17da3eec79e100"
            ),
            f"{_PLATES}MooneyRivlin_noise0.01.npz": (
                "8731a3eda68868b7aef82ad42f6038f0086cf8e13a5f095774e3e29988596da6"
            ),
            f"{_PLATES}Blatz_noise0.0.npz": (
                "c2f7541f345cffd40d38552acf3124b829a8515f0470824ae83082316e3c412d"
            ),
            f"{_PLATES}Blatz_noise0.01.npz": (
                "d70ea51cced238aa578a6b08b2a43da5c6b042b7134bdbe0c276d13156a595bc"
            ),
        },
    ),
    "viscoelastic_curves": PublicCollection(
        "NatLabRockies/pyvisco",
        "b61b5a0",
        licence="BSD-3-Clause",
        citation="the authors of pyvisco, Alliance for Energy Innovation",
        files={
            "sample_data/freq_user_master.csv": (
                "bd8d877ba95bba874ec927afcc5ddc64373688738acb03b6ae661497dc764810"
            ),
            "sample_data/freq_user_master__shift_factors.csv": (
                "61347b02bf8ea0f77c8fc110487c7fa8627d851c5eddb4073cb49677ab2fc3d5"
            ),
            "sample_data/freq_user_raw.csv": (
                "313a663bcb8c0602773902f06cddf8e5150028d29577e717d70ea932bb708a1d"
            ),
            "sample_data/time_user_master.csv": (
                "a925a5b1906af78f31d7bb61301b158cc38bd34081fc8368a0b279075511077b"
            ),
            "sample_data/time_user_raw.csv": (
                "19b5bb619eb6996f3e52d7af284d85ce01f50fe4441253e33389526e78ac7bb8"
            ),
            "sample_data/time_user_raw__shift_factors.csv": (
                "0d0f9efbb67f28c528d35af27a35faef97faa985a2dab01f76d6f5bd4bcba02a"
            ),
        },
    ),
}


def data_folder() -> Path:
    """Return the folder of downloaded data: ``COLLOCATION_SYSID_DATA``, or `datasets` in the cache
    folder of the package. It need not exist.
    """
    override = os.environ.get("COLLOCATION_SYSID_DATA")
    return Path(override) if override else cache_folder() / "datasets"


@validated
def fetch(name: str) -> Path:
    """Return the folder with the files of a data set, which are downloaded at the first use.

    A data set of the package (`DATASETS`) needs no network. The public collections need the extra
    `datasets`, and come from a fixed commit of a repository on GitHub; files are compared with their
    checksums at every use. They are kept in the folder that the environment variable
    ``COLLOCATION_SYSID_DATA`` names, by default the cache folder of the package; a copy that is put
    there in NAME/ needs no network, either.

    - ``hyperelastic_curves``: stress and stretch of rubbers, gels, silicone and brain tissue,
      `data.h5`, which `hyperelastic_curves` reads. MIT licence; repository
      Chongran-Zhao/Calibration-Hyperelasticity. Cite the paper of each curve, which
      `hyperelastic_curves` lists. Its checksum is not known, so that it is not downloaded: put a
      copy of the file there.
    - ``plate_fingerprint``: simulated plate with a hole, a mesh (.msh), and displacements and
      reactions (.npz) of three laws without noise and with 1 %. MIT licence; repository
      Material-Fingerprinting/material-fingerprinting-hyperelasticity. Cite M. Flaschel, D.
      Martonová, C. Veil, E. Kuhl, Material Fingerprinting: A shortcut to material model discovery
      without solving optimization problems (2025).
    - ``viscoelastic_curves``: relaxation and dynamic moduli of a polymer, raw and as master curves
      with shift factors (.csv, units in the second line). BSD-3-Clause licence; repository
      NatLabRockies/pyvisco. Cite the authors of pyvisco, Alliance for Energy Innovation.

    Parameters
    ----------
    name : str
        One of `DATASETS`, or of the public collections.

    Returns
    -------
    Path
        Folder of the files, whose names are those of the source.

    Raises
    ------
    InputError
        For an unknown name, without pooch, or if a file can neither be found nor downloaded, or
        differs from its checksum.
    """
    if name in DATASETS:
        return dataset_folder(name)
    require_among(name, [*COLLECTIONS, *DATASETS], where="dataset")
    folder = data_folder() / name
    _download(name, COLLECTIONS[name], folder)
    return folder


def _download(name: str, collection: PublicCollection, folder: Path) -> None:
    try:
        import pooch
    except ImportError as error:
        raise InputError(
            f"the data set {name!r} is downloaded by pooch, which is missing; expected {INSTALLATION}",
            where="dataset",
        ) from error
    urls = {PurePosixPath(path).name: collection.url(path) for path in collection.files}
    checksums = dict(zip(urls, collection.files.values(), strict=True))
    downloads = pooch.create(folder, "", registry=checksums, urls=urls)
    for file, url in urls.items():
        if checksums[file] is None:
            if not (folder / file).is_file():
                raise InputError(
                    f"{url} of the data set {name!r} is not downloaded, because its checksum is not "
                    f"known; expected a copy of the file as {folder / file}",
                    where="dataset",
                )
            continue
        try:
            downloads.fetch(file)
        except ValueError as error:  # pooch's, for another checksum
            raise InputError(
                f"{url} of the data set {name!r} differs from its checksum; expected SHA-256 "
                f"{checksums[file]}: the download is incomplete or the source has changed; nothing "
                "was kept",
                where="dataset",
            ) from error
        except OSError as error:  # of the network, which requests derives from it, or of the folder
            raise InputError(
                f"{url} of the data set {name!r} cannot be downloaded ({type(error).__name__}); "
                f"expected a network, or a copy of the file as {folder / file}",
                where="dataset",
            ) from error
