"""Public collections: download, checksum, cache, and messages; their curves as experiments."""

from __future__ import annotations

import hashlib
import sys
import threading
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import h5py
import numpy as np
import pytest

import collocation_sysid as cs
from collocation_sysid.datasets import public_data

pytest.importorskip("pooch")
NAME = "plate_fingerprint"
CONTENT = b"as its author wrote it"
# Copies of the collections, in folders of their names.
COPIES = Path("shared/data")
FOLDER = next((p / COPIES for p in Path(__file__).parents if (p / COPIES).is_dir()), None)


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def data(tmp_path, monkeypatch) -> Path:
    """The folder of downloaded data, empty."""
    monkeypatch.setenv("COLLOCATION_SYSID_DATA", str(tmp_path / "data"))
    return tmp_path / "data"


@pytest.fixture
def served(tmp_path, monkeypatch, data) -> Path:
    """A file of a collection with one file, on a server of this machine in place of GitHub."""
    checksum = hashlib.sha256(CONTENT).hexdigest()
    small = replace(public_data.COLLECTIONS[NAME], files={"folder/a.npz": checksum})
    monkeypatch.setitem(public_data.COLLECTIONS, NAME, small)
    file = tmp_path / "server" / small.repository / "raw" / small.commit / "folder" / "a.npz"
    file.parent.mkdir(parents=True)
    file.write_bytes(CONTENT)
    handler = partial(_Quiet, directory=tmp_path / "server")
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
        monkeypatch.setattr(public_data, "HOST", f"http://127.0.0.1:{server.server_port}")
        yield file
        server.shutdown()


def test_a_file_is_downloaded_once_and_then_needs_no_server(served, data, monkeypatch):
    folder = cs.datasets.fetch(NAME)
    assert folder == data / NAME
    assert (folder / "a.npz").read_bytes() == CONTENT
    monkeypatch.setattr(public_data, "HOST", "http://127.0.0.1:9")
    assert cs.datasets.fetch(NAME) == folder


def test_another_content_is_refused_and_not_kept(served, data):
    served.write_bytes(b"something else")
    with pytest.raises(cs.InputError, match=r"a\.npz .*differs from its checksum; expected SHA"):
        cs.datasets.fetch(NAME)
    assert not any(data.rglob("*.npz"))


def test_a_damaged_copy_is_downloaded_again(served, data):
    (data / NAME).mkdir(parents=True)
    (data / NAME / "a.npz").write_bytes(b"as its")
    assert (cs.datasets.fetch(NAME) / "a.npz").read_bytes() == CONTENT


@pytest.mark.parametrize("reason", ["no network", "no file"])
def test_a_failed_download_names_the_place_for_a_copy(served, data, monkeypatch, reason):
    if reason == "no file":
        served.unlink()
    else:
        monkeypatch.setattr(public_data, "HOST", "http://127.0.0.1:9")
    with pytest.raises(cs.InputError) as error:
        cs.datasets.fetch(NAME)
    assert "cannot be downloaded" in str(error.value)
    assert str(data / NAME / "a.npz") in str(error.value)
    assert not any(data.rglob("*.npz"))


def test_without_pooch_the_extra_is_named(data, monkeypatch):
    monkeypatch.setitem(sys.modules, "pooch", None)
    with pytest.raises(cs.InputError, match=r"pip install 'collocation-sysid\[datasets\]'"):
        cs.datasets.fetch(NAME)


def test_a_dataset_of_the_package_is_fetched_without_a_network(data):
    assert (cs.datasets.fetch("kawabata_1981") / "uniaxial.csv").is_file()
    assert not data.exists()
    with pytest.raises(cs.InputError, match="did you mean 'plate_fingerprint'"):
        cs.datasets.fetch("plate")


def test_every_collection_states_licence_repository_and_citation():
    text = " ".join(cs.datasets.fetch.__doc__.split())
    for name, collection in public_data.COLLECTIONS.items():
        start = text.index(f"``{name}``")
        entry = text[start : text.find("- ``", start) if "- ``" in text[start:] else None]
        assert f"{collection.licence} licence" in entry
        assert collection.repository in entry
        assert f"Cite {collection.citation}" in entry


def test_a_file_without_a_checksum_is_not_downloaded(served, data, monkeypatch):
    (path,) = public_data.COLLECTIONS[NAME].files
    unknown = replace(public_data.COLLECTIONS[NAME], files={path: None})
    monkeypatch.setitem(public_data.COLLECTIONS, NAME, unknown)
    with pytest.raises(cs.InputError, match=r"its checksum is not known; expected a copy .*a\.npz"):
        cs.datasets.fetch(NAME)
    assert not any(data.rglob("*.npz"))
    (data / NAME).mkdir(parents=True)
    (data / NAME / "a.npz").write_bytes(CONTENT)
    assert cs.datasets.fetch(NAME) == data / NAME


def test_every_checksum_is_known_or_the_page_says_that_there_is_none():
    text = " ".join(cs.datasets.fetch.__doc__.split())
    for collection in public_data.COLLECTIONS.values():
        for checksum in collection.files.values():
            assert checksum is None or len(bytes.fromhex(checksum)) == 32
    unknown = [n for n, c in public_data.COLLECTIONS.items() if None in c.files.values()]
    assert unknown == ["hyperelastic_curves"]
    assert "Its checksum is not known, so that it is not downloaded" in text


@pytest.mark.parametrize("content", [b"", b"no HDF5", b"\x89HDF\r\n\x1a\n" + bytes(100)])
def test_a_damaged_file_of_curves_is_refused(data, content):
    (data / "hyperelastic_curves").mkdir(parents=True)
    (data / "hyperelastic_curves" / "data.h5").write_bytes(content)
    with pytest.raises(cs.InputError, match=r"data\.h5"):
        cs.datasets.hyperelastic_curves("Meunier_2008", "yeoh")


@pytest.mark.parametrize("name", ["plate_fingerprint", "viscoelastic_curves"])
def test_checksums_are_those_of_the_files(name):
    if FOLDER is None or not (FOLDER / name).is_dir():
        pytest.skip("no copies of the collections are present")
    found = {hashlib.sha256(each.read_bytes()).hexdigest() for each in (FOLDER / name).glob("*.*")}
    assert {*public_data.COLLECTIONS[name].files.values()} <= found


@pytest.fixture
def curves(data) -> Path:
    """A small file of the layout of `hyperelastic_curves`."""
    file = data / "hyperelastic_curves" / "data.h5"
    file.parent.mkdir(parents=True)
    with h5py.File(file, "w") as content:

        def add(test: str, gradients: list[np.ndarray], stresses: list[np.ndarray]) -> None:
            content[f"{test}/F"] = np.array(gradients)
            content[f"{test}/stress"] = np.array(stresses)

        stretches = np.array([1.0, 1.1, 1.3])
        add(
            "Meunier_2008/UT",
            [np.diag([each, each**-0.5, each**-0.5]) for each in stretches],
            [np.diag([2 * (each - each**-2), 0, 0]) for each in stretches],
        )
        add(
            "Kawamura_2001/BT_lambda_1d5",
            [np.diag([each, 1.5, 1 / (1.5 * each)]) for each in stretches],
            [np.diag([each, 2 * each, 0]) for each in stretches],
        )
        sheared = [np.diag([0.75, 0.75**-0.5, 0.75**-0.5]) for _ in range(3)]
        for gradient, amount in zip(sheared, (-0.1, 0.0, 0.2), strict=True):
            gradient[0, 1] = amount
        shear = [np.outer([1, 0, 0], [0, 3 * amount, 0]) for amount in (-0.1, 0.0, 0.2)]
        add("Budday_2017/CSS_cortex_lambda_0d75", sheared, shear)
    return file


def test_curves_become_specimens_in_si_units(curves):
    (pull,) = cs.datasets.hyperelastic_curves("Meunier_2008", "yeoh", tests=["UT"])
    assert (pull.name, pull.specimen.test) == ("UT", "uniaxial")
    assert pull.measurements[0].measured_values[:, 0] == pytest.approx(
        [0, 0.5471e6, 1.4166e6], rel=1e-4
    )
    (biaxial,) = cs.datasets.hyperelastic_curves("Kawamura_2001", "yeoh")
    assert [each.name for each in biaxial.measurements] == ["stress", "second stress"]
    (shear,) = cs.datasets.hyperelastic_curves("Budday_2017", "ogden-1", sigma_pa=20.0)
    assert shear.specimen.scale == 0.75  # the stretch along the normal of the sheared planes
    assert shear.measurements[0].measured_values[:, 0] == pytest.approx([-300.0, 0.0, 600.0])


def test_unknown_authors_and_tests_are_refused_with_the_known_names(curves):
    with pytest.raises(cs.InputError, match=r"author: found 'Meunier'.*mean 'Meunier_2008'"):
        cs.datasets.hyperelastic_curves("Meunier", "yeoh")
    with pytest.raises(cs.InputError, match=r"tests: found 'ET'; expected one of UT"):
        cs.datasets.hyperelastic_curves("Meunier_2008", "yeoh", tests=["ET"])
