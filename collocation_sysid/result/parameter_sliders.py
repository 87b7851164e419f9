"""Sliders over the estimated parameters of a run, with a forward simulation beside the recording.

For notebooks, with the widgets of ipywidgets (extra ``interactive``).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from io import BytesIO
from typing import TYPE_CHECKING, Any

import numpy as np

from ..common.array_types import Array
from ..common.display import number
from ..errors import InputError, SimulationError, require_among
from ..features.registry import FEATURES
from ..fem.laws.constants import symbol_with_unit
from ..model.parameters import Parameters
from ..problem import Problem
from ..program.transcription import Transcription
from ..recording import Experiment
from ..runs.forward_simulation import (
    ForwardSimulation,
    simulate_with_parameters,
    transcription_and_nuisance,
)
from ..runs.result_content import ReportedEstimate
from ..runs.solved_problem import SolvedProblem

if TYPE_CHECKING:
    from matplotlib.figure import Figure  # which takes a while to import

MISSING = "run.interactive() needs ipywidgets: pip install 'collocation-sysid[interactive]'"
# Least ratio of the ends of a slider to its middle; an interval may be too short to see an effect.
LEAST_RATIO = 1.5
# Distance of a slider's ends from those of the combined interval, in half widths of the interval.
WIDENING = 2.0
# Steps of a slider.
STEPS = 200
# Resolution of the pictures [pixels per inch]: a notebook redraws them for every value.
PICTURE_DPI = 90


@dataclass(frozen=True)
class SliderRange:
    """Values that a slider can take.

    Attributes
    ----------
    low, value, high : float
        Ends and first value.
    is_logarithmic : bool
        Whether the slider has a logarithmic scale.
    """

    low: float
    value: float
    high: float
    is_logarithmic: bool

    @classmethod
    def from_estimate(
        cls, estimate: ReportedEstimate, *, linear: bool, bounds: tuple[float, float]
    ) -> SliderRange:
        """Return a range around an estimate.

        It reaches three half widths of the combined interval to either side (on a logarithmic scale
        unless `linear` or the value is not positive), at least a factor of 1.5 or half of the
        value, and not beyond the bounds. Without an interval the least range is used, from −1 to 1
        for an estimate of zero. An estimate beyond a bound is moved to the bound.

        Parameters
        ----------
        estimate : ReportedEstimate
            Estimate with its combined interval.
        linear : bool
            Whether the parameter is estimated on a linear scale.
        bounds : (lower, upper)
            Bounds of the parameter.
        """
        value = estimate.value
        interval = estimate.combined95 or (value, value)
        if linear or value <= 0:
            margin = (1 + WIDENING) * max(value - interval[0], interval[1] - value)
            margin = max(margin, (LEAST_RATIO - 1) * abs(value)) or 1.0
            low = value - margin
            high = value + margin
        else:
            ratio = max(interval[1] / value, value / max(interval[0], 1e-12 * value))
            factor = max(ratio ** (1 + WIDENING), LEAST_RATIO)
            low = value / factor
            high = value * factor
        is_logarithmic = not linear and value > 0
        low = max(low, bounds[0])
        high = min(high, bounds[1])
        return cls(low, float(np.clip(value, low, high)), high=high, is_logarithmic=is_logarithmic)


class ParameterSliders:
    """Sliders and pictures of one experiment of a run.

    Parameters
    ----------
    problem : Problem
        Its integrator and step are used.
    experiment : Experiment
        The recording.
    transcription : Transcription
        The recording as it was fitted.
    phi : (k,) array
        Nuisance parameters of the recording, which stay as estimated.
    parameters : Parameters
        Parameters of the problem, with the optimum as guesses.
    ranges : mapping of name to SliderRange
        Parameters that get a slider.
    fitted_markers_m : (T, M, 3) array or None
        Fitted markers; None for a validation experiment.

    Attributes
    ----------
    sliders : dict of name to widget
        Their `value` is the value of the parameter.
    picture : widget
        PNG of measurements, fit and simulation.
    message : widget
        Misfit of the simulation, or why it failed.
    reset_button : widget
        Sets all sliders to the estimates.
    widget : widget
        Box with all of them.
    simulation : ForwardSimulation or None
        The last simulation; None if it failed.
    """

    def __init__(
        self,
        problem: Problem,
        experiment: Experiment,
        *,
        transcription: Transcription,
        phi: Array,
        parameters: Parameters,
        ranges: Mapping[str, SliderRange],
        fitted_markers_m: Array | None,
    ) -> None:
        widgets: Any = import_module("ipywidgets")
        self._problem = problem
        self._experiment = experiment
        self._segment = transcription
        self._phi = phi
        self._parameters = parameters
        self._ranges = ranges
        self._fitted_markers_m = fitted_markers_m
        self._is_resetting = False
        self.simulation: ForwardSimulation | None = None
        self.sliders = {name: _slider(widgets, name, values=each) for name, each in ranges.items()}
        self.picture = widgets.Image(format="png")
        self.message = widgets.Label()
        self.reset_button = widgets.Button(description="estimates")
        controls = widgets.VBox([*self.sliders.values(), self.reset_button, self.message])
        self.widget = widgets.HBox([controls, self.picture])
        for slider in self.sliders.values():
            slider.observe(self._on_change, names="value")
        self.reset_button.on_click(self.reset)
        self.update()

    @classmethod
    def from_run(cls, run: SolvedProblem, experiment: str | None = None) -> ParameterSliders:
        """Return the sliders of a run, see `Run.interactive`; the first simulation is made at once.

        If that fails, `simulation` is None and the message says why.

        Parameters
        ----------
        run : SolvedProblem
            Run with at least one estimated parameter.
        experiment : str, optional
            Name of the recording, which may be one for validation; the first of the problem by
            default.

        Raises
        ------
        InputError
            Without ipywidgets, for an unknown experiment, or if no parameter was estimated.
        """
        if find_spec("ipywidgets") is None:
            raise InputError(MISSING)
        by_name = {each.name: each for each in run.problem.experiments}
        name = next(iter(by_name)) if experiment is None else experiment
        require_among(name, by_name)
        names = [each.name for each in run.solution.collocation.parameters.free_scalars]
        if not names:
            raise InputError(
                "no parameter was estimated; expected a run with one that is not fixed, because "
                "sliders change estimated parameters"
            )
        ranges = {}
        for each in names:
            linear, bounds = run.solution.collocation.parameters.scale_and_bounds(each)
            ranges[each] = SliderRange.from_estimate(
                run.estimates[each], linear=linear, bounds=bounds
            )
        transcription, phi = transcription_and_nuisance(by_name[name], run.solution)
        fitted = zip(run.solution.parts, run.solution.readings_m, strict=True)
        markers_m = {part.transcription.experiment.name: readings for part, readings in fitted}
        return cls(
            run.problem,
            by_name[name],
            transcription=transcription,
            phi=phi,
            parameters=run.solution.collocation.parameters.with_estimates(
                {
                    each.name: run.solution.parameters[each.name]
                    for each in run.solution.collocation.parameters.free
                }
            ),
            ranges=ranges,
            fitted_markers_m=markers_m.get(name),
        )

    def read_values(self) -> dict[str, float]:
        """Return all parameters by name: those of the sliders, those tied to them, and the others
        at the optimum.
        """
        chosen = {name: each.value for name, each in self.sliders.items()}
        return self._parameters.with_estimates(chosen).guesses

    def reset(self, _: object = None) -> None:
        """Set all sliders to the estimates, and simulate once; the argument, the button that was
        clicked, is not used.
        """
        self._is_resetting = True
        try:
            for name, slider in self.sliders.items():
                slider.value = self._ranges[name].value
        finally:
            self._is_resetting = False
        self.update()

    def update(self) -> None:
        """Simulate with the values of the sliders, and show the result.

        The simulation is stored in `simulation`. If it fails with an InputError or a
        SimulationError, `simulation` is None, the message says why, and the last picture stays.
        """
        self.message.value = "simulating"
        try:
            self.simulation = simulate_with_parameters(
                self._problem,
                self._experiment,
                transcription=self._segment,
                phi=self._phi,
                parameters=self.read_values(),
            )
        except (InputError, SimulationError) as error:
            self.simulation = None
            self.message.value = f"not simulated: {error}"
            return
        self.message.value = self._misfit_text(self.simulation)
        self.picture.value = _png(self._figure(self.simulation))

    def _on_change(self, _: Mapping[str, Any]) -> None:
        """Simulate again, unless all sliders are being reset; the argument, the change of a slider,
        is not used.
        """
        if not self._is_resetting:
            self.update()

    def _misfit_text(self, simulation: ForwardSimulation) -> str:
        """Return the RMS differences from the measurements in words, separated by semicolons.

        They are of markers [mm], also the largest, and of all features, those of custom sensors
        without their unit; without any measurement the text says so.
        """
        texts = []
        if len(self._experiment.markers.names):
            rms_mm = number(1e3 * simulation.rms_m, 3)
            max_mm = number(1e3 * simulation.max_m, 3)
            texts.append(f"markers: {rms_mm} mm RMS, at most {max_mm} mm")
        texts += [text for feature in FEATURES for text in feature.brief_texts(simulation.error)]
        return "; ".join(texts) or "no measurement to compare with"

    def _figure(self, simulation: ForwardSimulation) -> Figure:
        """Return the picture of the first kind of measurements that the recording has: all markers,
        else the first sensor; without these, the picture of the shapes.

        Forces of sensors are those on the complete specimen.
        """
        from .pictures.over_time import marker_tracks, sensor_picture

        experiment = self._experiment
        if len(experiment.markers.names):
            return marker_tracks(
                experiment.t_s,
                experiment.markers.names,
                measured_m=experiment.markers.positions_m,
                fitted_m=self._fitted_markers_m,
                simulated_m=simulation.trajectory.markers_m,
            )
        for feature in FEATURES:
            for series in feature.simulated_series(experiment, simulation.predicted):
                return sensor_picture(series.columns, series.names, units=series.units)
        return self._shapes_figure(simulation)

    def _shapes_figure(self, simulation: ForwardSimulation) -> Figure:
        """Return the picture of the simulated shapes of the body at several times, with the
        measured markers.
        """
        from .pictures.shapes import shapes_picture
        from .replay import MotionRecord

        trajectory = simulation.trajectory
        simulated = trajectory.positions_m, trajectory.markers_m
        return shapes_picture(MotionRecord.from_experiment(self._experiment, simulated=simulated))


def _slider(widgets: Any, name: str, values: SliderRange) -> Any:
    """Return the slider of a parameter, which reports its value when it is released."""
    common = {
        "description": symbol_with_unit(name),
        "continuous_update": False,
        "readout_format": ".4g",
    }
    if values.is_logarithmic:
        low = float(np.log10(values.low))
        high = float(np.log10(values.high))
        return widgets.FloatLogSlider(
            value=values.value, base=10, min=low, max=high, step=(high - low) / STEPS, **common
        )
    step = (values.high - values.low) / STEPS
    return widgets.FloatSlider(
        value=values.value, min=values.low, max=values.high, step=step, **common
    )


def _png(figure: Figure) -> bytes:
    """Return a figure as bytes of a PNG file."""
    png = BytesIO()
    figure.savefig(png, dpi=PICTURE_DPI)
    return png.getvalue()
