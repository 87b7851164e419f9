"""Calls of the Python interface with values that are wrong, or of other libraries."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from kit.problem_files import write_problem

import collocation_sysid as cs
from collocation_sysid.common.checked_arrays import float_array
from collocation_sysid.errors import InputError

T_S = 0.01 * np.arange(5)
PLACES_M = [(0.0, 0.0, 0.0), (0.1, 0.0, 0.0)]
TRACKS_M = np.tile(PLACES_M, (5, 1, 1))


def cube() -> cs.Body:
    return cs.Body(cs.box_mesh((0.1, 0.1, 0.1), (1, 1, 1)), density_kg_m3=30.0)


def lifted(**changes: Any) -> cs.Experiment:
    grasp = cs.Grasp(cs.Face("top"), cs.PoseSequence.fixed())
    markers = cs.Markers(T_S, TRACKS_M, 1e-3, places_m=PLACES_M)
    return cs.Experiment(
        **{"body": cube(), "t_s": T_S, "grasps": grasp, "markers": markers} | changes
    )


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: cs.Body("x", density_kg_m3=30.0), "Body: mesh is 'x'; expected a TetMesh"),  # pyright: ignore[reportArgumentType]
        (lambda: cs.Unknown("300"), "Unknown: guess is '300'; expected a number"),  # pyright: ignore[reportArgumentType]
        (lambda: cs.Unknown(scale="lg"), "scale is 'lg'; expected 'log' or 'linear'"),  # pyright: ignore[reportArgumentType]
        (lambda: cs.run(5), "run: problem is 5; expected a Problem"),  # pyright: ignore[reportArgumentType]
        (lambda: cs.run("none.toml"), "none.toml: there is no such file"),
        (lambda: cs.Ball((0, 0, 0), 1j), "Ball: radius_m is 1j; expected a number"),  # pyright: ignore[reportArgumentType]
        (lambda: cs.Parameter("mu_pa", True), "Parameter 'mu_pa': guess is True"),
        (lambda: cs.Experiment(cube(), T_S, 5), "grasps is 5; expected a Grasp"),  # pyright: ignore[reportArgumentType]
        (lambda: cs.Experiment(cube(), T_S, [5]), "grasps[0] is 5; expected a Grasp"),  # pyright: ignore[reportArgumentType]
        (lambda: cs.Experiment(5, T_S, []), "the body is a int; expected a Body"),  # pyright: ignore[reportArgumentType]
        (lambda: cs.Markers(T_S, TRACKS_M * 1j, 1e-3), "complex numbers"),
        (lambda: cs.Markers(T_S, TRACKS_M, 1e-300), "at least 1e-12 m"),
    ],
)
def test_a_wrong_value_is_named_with_what_was_expected(call: Any, message: str):
    with pytest.raises(InputError, match=re.escape(message)):
        call()


@pytest.mark.parametrize("call", [cs.solve, cs.run])
def test_a_body_that_is_held_at_all_nodes_is_refused(call: Any):
    held = lifted(grasps=cs.Grasp(range(8), cs.PoseSequence.fixed()))
    known = {"poisson": 0.3, "gamma_r_s": 0.01, "gamma_m_1_s": 1.0}
    problem = cs.Problem(held, {"young_pa": cs.Unknown(1e4), **known})
    with pytest.raises(InputError, match="grasps hold all 8 nodes, so that nothing can move"):
        call(problem)
    with pytest.raises(InputError, match="hold all 8 nodes"):
        cs.simulate(held, {"young_pa": 1e4, **known})


def test_scalars_of_numpy_count_as_those_of_python():
    body = cs.Body(cs.box_mesh((0.1, 0.1, 0.1), np.array([1, 1, 1])), "neo-hookean", np.float32(30))
    assert type(body.parts[0].density_kg_m3) is float
    assert cs.Unknown(np.int64(300)).guess == 300.0
    assert lifted(validation=np.True_).validation is True


def test_one_object_counts_as_a_list_of_one():
    assert len(lifted().grasps) == 1
    assert cs.Markers(T_S, TRACKS_M[:, :1], 1e-3, "tip").names == ("tip",)


def test_a_path_counts_as_the_problem_in_the_file(tmp_path):
    path = write_problem(tmp_path, {"swing": 8})
    solved: list[Any] = []

    def method(collocation: Any, *_: Any) -> Any:
        solved.append(collocation)
        raise StopIteration

    for each in (path, str(path)):
        with pytest.raises(StopIteration):
            cs.solve(each, method)
    assert len(solved) == 2


def test_masked_entries_are_missing():
    masked = np.ma.masked_array(TRACKS_M, np.zeros_like(TRACKS_M, dtype=bool))
    masked[2, 1] = np.ma.masked
    markers = cs.Markers(T_S, masked, 1e-3)
    assert np.isnan(markers.positions_m[2, 1]).all()
    assert np.isfinite(markers.positions_m).sum() == TRACKS_M.size - 3


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ([1j], "complex numbers"),
        ([True], "truth values"),
        (["1"], "texts"),
        (np.array(["2024-01-01"], dtype="datetime64[s]"), "dates"),
        ([[1.0], [1.0, 2.0]], "must hold numbers"),
        ([[1.0]], r"the shape \(1, 1\); expected \(2\)"),
        ([1.0, np.inf], r"lengths\[1\] is inf"),
        ([1.0, 1e200], r"lengths\[1\] is 1e\+200"),
    ],
)
def test_an_array_whose_meaning_would_be_lost_is_refused(values: Any, message: str):
    with pytest.raises(InputError, match=message):
        float_array(values, "lengths", (2,) if "shape" in message else ())


def test_tables_of_pandas_count_as_their_numbers():
    pd = pytest.importorskip("pandas")
    table = pd.DataFrame({"t_s": T_S, "x_m": TRACKS_M[:, 0, 0]})
    assert np.array_equal(float_array(table["t_s"], "t_s", (None,)), T_S)
    with_gap = pd.array([1.0, None], dtype="Float64")
    assert np.isnan(float_array(with_gap, "x_m", finite=False)[1])
    markers = cs.Markers(table["t_s"], TRACKS_M, pd.Series([1e-3, 2e-3]), pd.Index(["a", "b"]))
    assert markers.names == ("a", "b")
    assert np.array_equal(markers.sigma_m, [1e-3, 2e-3])
    theta = pd.Series({"lambda_pa": 200.0, "mu_pa": 300.0, "gamma_r_s": 0.01, "gamma_m_1_s": 1.0})
    by_name = cs.simulate(lifted(), dict(theta)).positions_m
    assert np.array_equal(cs.simulate(lifted(), theta[::-1]).positions_m, by_name)


def test_arrays_of_xarray_count_as_their_numbers():
    xr = pytest.importorskip("xarray")
    tracks = xr.DataArray(TRACKS_M, dims=("t", "marker", "axis"), coords={"t": T_S})
    markers = cs.Markers(tracks.t, tracks, 1e-3)
    assert np.array_equal(markers.positions_m, TRACKS_M)
    assert np.array_equal(markers.t_s, T_S)
