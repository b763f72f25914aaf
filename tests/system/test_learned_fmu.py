"""Learned models as FMUs: networks in loops, what they say of their range, and their model card."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from ctypes import c_double
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from export_helpers import Instance, instance

from exlinn_fmi.export.build import export_learned
from exlinn_fmi.export.card import Card
from exlinn_fmi.export.check import check_fmu
from exlinn_fmi.export.model import expanded_model, system_model
from exlinn_fmi.mechanics.coordinates import Coordinate
from exlinn_fmi.mechanics.euler_lagrange import evaluate
from exlinn_fmi.mechanics.expansion import expand
from exlinn_fmi.mechanics.learned import ModelSpec, Scales, Weights, learned_system
from exlinn_fmi.plants import plant

PLANT = plant("dc_motor_cart")
LINE = (Coordinate("s", "m", input="f", input_unit="N"), PLANT.coordinates[1])
RANGES = {"alpha": (0.0, 6.0), "alpha_dot": (-3.0, 3.0), "i": (-2.0, 2.0), "v": (-10.0, 10.0)}


def structured(
    hidden: int = 4, depth: int = 1, coordinates: tuple[Coordinate, ...] = PLANT.coordinates
) -> ModelSpec:
    scales = Scales(0.2, 1.0, (1.0, 0.5), (0.0, 0.0), (1.0, 1.0))
    return ModelSpec("structured", coordinates, hidden, scales, (0.05, 0.05), depth=depth)


PAPER = ModelSpec(
    "features",
    PLANT.coordinates,
    4,
    None,
    (),
    ("alpha_dot^2", "sin(alpha)^2*alpha_dot^2", "i^2", "alpha*i"),
    ("alpha_dot^2", "i^2"),
)
SPECS = {
    "one layer": structured(),
    "three layers": structured(6, 3),
    "a line": structured(5, 2, LINE),
    "the paper's": PAPER,
}


def weights_of(spec: ModelSpec, seed: int = 0) -> Weights:
    rng = np.random.default_rng(seed)
    if spec.form == "features":
        return {name: np.abs(rng.normal(size=shape)) + 0.1 for name, shape in spec.shapes().items()}
    return {name: 0.3 * rng.normal(size=shape) for name, shape in spec.shapes().items()}


@pytest.fixture(scope="module", params=SPECS)
def spec(request: pytest.FixtureRequest) -> ModelSpec:
    return SPECS[request.param]


@pytest.fixture(scope="module")
def fmu(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fmu")
    return export_learned(
        structured(),
        weights_of(structured()),
        folder / "Learned.fmu",
        name="Learned",
        ranges=RANGES,
        card=Card(
            {"data_sha256": "abc", "ranges": RANGES},
            {"learn.force_mse_test": 1e-9},
            ({"name": "k_e", "identified": "1.01", "low": "0.9", "high": "1.1"},),
        ),
    )


@pytest.fixture
def cs(fmu: Path) -> Iterator[Instance]:
    with instance(fmu) as made:
        yield made


def boolean(made: Instance, name: str) -> bool:
    return bool(made.fmu.getBoolean([made.references[name]])[0])


# ── networks ─────────────────────────────────────────────────────────────────────────────────────────────


def test_expanded_equations_are_the_networks_own(spec: ModelSpec) -> None:
    expansion = expand(spec, weights_of(spec))
    assert expansion is not None
    outside = expanded_model(expansion, "M")
    inside = system_model(learned_system(spec, weights_of(spec)), "M")
    assert outside.solver_step == inside.solver_step
    pairs = zip(inside.dependencies, outside.dependencies, strict=True)
    assert all(set(own) <= set(told) for own, told in pairs)
    for z in np.random.default_rng(1).normal(size=(20, 5)):
        np.testing.assert_allclose(outside.evaluate(z), inside.evaluate(z), rtol=1e-11, atol=1e-12)


def test_native_networks_run_as_in_python(spec: ModelSpec, tmp_path: Path) -> None:
    weights = weights_of(spec)
    system = learned_system(spec, weights)
    start = dict(zip(system.state_names, (0.5, 1.0, -0.2), strict=True))
    path = export_learned(spec, weights, tmp_path, name="Native", start=start)
    with instance(path) as made:
        made.start()
        (h,) = made.get("solver_step")
        states = made.run(system.state_names, h, {"v": np.full(100, 5.0)})
    u = np.tile([[0.0], [5.0]], 100)
    expected = system.rk4().mapaccum(100)(list(start.values()), u, [], h).full().T
    np.testing.assert_allclose(states, expected, rtol=0, atol=1e-11)


def test_native_derivatives_are_exact(spec: ModelSpec, tmp_path: Path) -> None:
    """Directional ones against those of the unrolled network, by automatic differentiation."""
    weights = weights_of(spec)
    system = learned_system(spec, weights)
    with instance(export_learned(spec, weights, tmp_path, name="Native"), "me") as made:
        made.start(dict(zip(system.state_names, (0.5, 1.0, -0.2), strict=True)))
        made.set("v", 3.0)
        known = [made.references[n] for n in system.state_names]
        unknown = [made.references[c.acceleration] for c in system.coordinates]
        columns = [made.fmu.getDirectionalDerivative(unknown, [k], [1.0]) for k in known]
    exact = evaluate(system.state_jacobian, [0.5, 1.0, -0.2], [0.0, 3.0], np.zeros(0))[0]
    np.testing.assert_allclose(np.array(columns).T, exact[-2:], rtol=1e-10, atol=1e-11)


def test_a_model_without_a_network_has_no_expansion() -> None:
    spec = replace(PAPER, form="terms")
    assert expand(spec, {n: np.ones(s) for n, s in spec.shapes().items()}) is None


# ── the trained range ────────────────────────────────────────────────────────────────────────────────────


def test_it_is_valid_and_does_what_its_reference_says(fmu: Path) -> None:
    found = check_fmu(fmu)
    assert found.problems == ()
    assert max(found.runs.values()) < 1e-9


def test_range_limits_and_nominals_are_the_datas(cs: Instance) -> None:
    variables = {v.name: v for v in cs.description.modelVariables}
    assert (variables["v"].min, variables["v"].max, variables["v"].nominal) == ("-10.0", "10.0", "10.0")
    assert variables["alpha"].min is None  # a circle has no ends
    assert variables["alpha"].displayUnit == "deg"


def test_it_says_when_it_leaves_its_range_and_when_it_is_back(cs: Instance) -> None:
    cs.start()
    assert boolean(cs, "in_range")
    assert cs.get("range_margin") == [0.5]
    cs.set("v", 15.0)
    assert cs.get("range_margin") == [-0.25]
    assert not boolean(cs, "in_range")
    cs.fmu.doStep(0.0, 1e-3)
    cs.fmu.doStep(1e-3, 1e-3)
    (said,) = [text for text in cs.log if "trained" in text]
    assert said == "v is 15 at t = 0.001 s, the model was trained from -10 to 10: it extrapolates"
    cs.set("v", 5.0)
    cs.fmu.doStep(2e-3, 1e-3)
    assert boolean(cs, "in_range")


def test_clamped_it_sees_no_more_than_its_range(cs: Instance) -> None:
    cs.fmu.setBoolean([cs.references["clamp"]], [True])
    cs.start({"alpha_dot": 5.0})
    assert "evaluated at the end of that range" in cs.log[-1]
    beyond = cs.get("alpha_ddot", "i_dot")
    v = cs.references["alpha_dot"]
    unknown = [cs.references["alpha_ddot"], cs.references["i_dot"]]
    assert list(cs.fmu.getDirectionalDerivative(unknown, [v], [1.0])) == [0.0, 0.0]
    cs.fmu.doStep(0.0, 1e-3)
    assert cs.get("alpha")[0] == pytest.approx(5e-3, rel=0.02)  # it moves with its own velocity all the same
    cs.fmu.reset()
    cs.start({"alpha_dot": 3.0})
    assert cs.get("alpha_ddot", "i_dot") == beyond


def test_leaving_the_range_is_an_event_in_model_exchange(fmu: Path) -> None:
    with instance(fmu, "me") as made:
        made.start()
        made.fmu.newDiscreteStates()
        made.fmu.enterContinuousTimeMode()
        indicator = (c_double * 1)()
        made.fmu.setContinuousStates((c_double * 3)(0.0, 3.3, 0.0), 3)
        made.fmu.getEventIndicators(indicator, 1)
        assert indicator[0] == pytest.approx(-0.05)
        assert boolean(made, "in_range")  # until the event
        made.fmu.enterEventMode()
        made.fmu.newDiscreteStates()
        assert not boolean(made, "in_range")
        assert "alpha_dot is 3.3" in made.log[-1]


def test_start_values_lie_in_the_range(tmp_path: Path) -> None:
    ranges = {"i": (1.0, 2.0), "v": (3.0, 9.0)}
    with instance(
        export_learned(structured(), weights_of(structured()), tmp_path, name="S", ranges=ranges)
    ) as made:
        made.start()
        assert made.get("i", "v", "alpha_dot") == [1.0, 3.0, 0.0]


def test_the_card_tells_ranges_accuracy_parameters_and_data(fmu: Path) -> None:
    with zipfile.ZipFile(fmu) as archive:
        page = archive.read("documentation/index.html").decode()
        provenance = archive.read("extra/org.exlinn.fmi/provenance.json").decode()
    for text in ("-10 … 10", "1e-09", "0.9 … 1.1", "abc", "the model extrapolates", "in_range"):
        assert text in page, text
    assert '"data_sha256": "abc"' in provenance
