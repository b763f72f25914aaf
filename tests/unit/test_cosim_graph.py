"""The connection graph of real components: order, delays, words and refusals."""

from __future__ import annotations

from textwrap import dedent

import pytest
from cosim_helpers import Gain, Integrator, Lag, Small, Source, graph

from exlinn_fmi.components.base import Variable
from exlinn_fmi.cosim.graph import Graph
from exlinn_fmi.errors import InputError

LOOP = ("p.y > c.u", "c.y > p.u")


def acts(g: Graph) -> list[tuple[str, list[str], list[str]]]:
    """Visits in words: component, inputs set, outputs got."""
    found = []
    for v in g.visits:
        variables = g.components[g.names[v.component]].variables
        names = [[variables[k].name for k in indices] for indices in (v.inputs, v.outputs)]
        found.append((g.names[v.component], *names))
    return found


def test_plant_whose_outputs_are_states_is_no_obstacle_for_a_controller():
    g = graph([Gain("c", sampled=True), Lag("p")], *LOOP)
    assert acts(g) == [("p", [], ["y"]), ("c", ["u"], ["y"]), ("p", ["u"], [])]
    assert g.order == ("p", "c")
    assert g.delays == ()
    assert g.loops == ()


def test_plant_that_does_not_state_its_dependencies_is_read_first():
    g = graph([Gain("c", sampled=True), Lag("p", states=False)], *LOOP)
    assert acts(g) == [("p", [], ["y"]), ("c", ["u"], ["y"]), ("p", ["u"], [])]
    (delay,) = g.delays
    assert (delay.kind, delay.source, delay.target) == ("dependency", "p.u", "p.y")
    assert "p does not say whether y depends on u directly" in delay.reason
    assert g.loops == ()


def test_algebraic_loop_is_named_and_broken_where_it_leads_back():
    g = graph([Gain("a"), Gain("b"), Integrator("c")], "a.y > b.u", "b.y > a.u", "b.y > c.u")
    assert g.loops == (("a.u", "a.y", "b.u", "b.y"),)
    (delay,) = g.delays
    assert (delay.kind, delay.source, delay.target) == ("connection", "b.y", "a.u")
    assert delay.reason == "algebraic loop through a, b: the value of the communication point before is used"
    assert acts(g) == [("a", ["u"], ["y"]), ("b", ["u"], ["y"]), ("c", ["u"], [])]


def test_feed_through_chain_is_followed_whatever_the_order_of_the_scenario():
    g = graph([Gain("c"), Gain("b"), Gain("a"), Source("s", float)], "s.y > a.u", "a.y > b.u", "b.y > c.u")
    assert g.order == ("s", "a", "b", "c")


def test_equals_stand_in_the_order_of_the_scenario():
    assert graph([Source("z", float), Source("a", float), Integrator("m")]).order == ("z", "a", "m")


def test_two_components_may_feed_each_other_without_an_algebraic_loop():
    # a.y1 → b → a.u2 → a.y2: y1 does not depend on u2, so all values of an instant belong together.
    cross = Small(
        "a",
        Variable("u2", "input"),
        Variable("y1", "output"),
        Variable("y2", "output", depends_on=("u2",)),
    )
    g = graph([cross, Gain("b"), Gain("c")], "a.y1 > b.u", "b.y > a.u2", "a.y2 > c.u")
    assert g.delays == ()
    assert acts(g) == [("a", [], ["y1"]), ("b", ["u"], ["y"]), ("a", ["u2"], ["y2"]), ("c", ["u"], [])]


def test_component_that_feeds_itself_is_an_algebraic_loop():
    g = graph([Gain("a")], "a.y > a.u")
    assert g.loops == (("a.u", "a.y"),)
    assert g.delays[0].source == "a.y"


def test_one_output_may_feed_many_inputs():
    g = graph([Source("s", float), Gain("a"), Gain("b")], "s.y > a.u", "s.y > b.u")
    assert acts(g) == [("s", [], ["y"]), ("a", ["u"], []), ("b", ["u"], [])]


# ── words ────────────────────────────────────────────────────────────────────────────────────────────────


def test_description_tells_all_there_is_to_know():
    components = [
        Gain("ctrl", sampled=True),
        Lag("plant", states=False),
        *map(Integrator, ("meter", "spare")),
    ]
    g = graph(components, "plant.y > ctrl.u", "ctrl.y > plant.u", "plant.rate > meter.u")
    expected = """\
        components, in the order in which their outputs are known
          spare  0 of 1 inputs connected, 0 of 1 outputs connected
          plant  1 of 1 inputs connected, 2 of 2 outputs connected
          ctrl   1 of 1 inputs connected, 1 of 1 outputs connected, sampled
          meter  1 of 1 inputs connected, 0 of 1 outputs connected
        connections
          plant.y → ctrl.u [-]
          ctrl.y → plant.u [-]
          plant.rate → meter.u [m/s]
        inputs that keep their start values
          spare.u
        direct feed-through between connected variables
          ctrl: u → y
          plant: u → y (not stated)
          plant: u → rate (not stated)
        order of values at a communication point
          plant  get y
          ctrl   set u, get y
          plant  set u, get rate
          meter  set u
        algebraic loops
          none
        one step late
          plant.u → plant.y: """
    reason = "plant does not say whether y depends on u directly; taken not to, or a loop would close"
    assert g.describe() == dedent(expected) + reason


def test_description_shows_units_that_differ():
    assert "a.y → b.u [m → m/s]" in graph([Integrator("a"), Integrator("b")], "a.y > b.u").describe()


def test_description_shows_algebraic_loops():
    text = graph([Gain("a"), Gain("b")], "a.y > b.u", "b.y > a.u").describe()
    assert "a.u — a.y — b.u — b.y" in text
    assert "b.y → a.u: algebraic loop through a, b" in text


def test_description_says_that_loops_are_solved():
    text = graph([Gain("a"), Gain("b")], "a.y > b.u", "b.y > a.u").describe("newton")
    assert "algebraic loops, solved at each communication point (newton)\n  a.u — a.y — b.u — b.y" in text
    assert text.endswith("one step late\n  none")


def test_description_shortens_long_lists():
    wide = Small("w", *(Variable(f"y{k}", "output") for k in range(20)))
    sink = Small("s", *(Variable(f"u{k}", "input") for k in range(20)))
    text = graph([wide, sink], *(f"w.y{k} > s.u{k}" for k in range(20))).describe()
    assert "get y0, y1, y2, y3, y4, y5, y6, y7 … (12 more)" in text


def test_graph_without_connections_or_components_is_described():
    assert "none" in Graph({}, []).describe()
    assert Graph({}, []).order == ()


# ── refusals ─────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("connection", "text"),
    [
        ("sorce.y > plant.u", r"sorce.y: no component 'sorce'; did you mean 'source'\?"),
        (
            "source.y > plant.v",
            r"plant.v: component 'plant' has no variable 'v'; the variables are: u, y, gain",
        ),
        ("plant.u > plant.u", r"plant.u is of causality input; a connection starts at an output"),
        ("source.y > plant.gain", r"plant.gain is of causality parameter; a connection ends at an input"),
    ],
)
def test_impossible_connection_is_refused(connection: str, text: str):
    with pytest.raises(InputError, match=text):
        graph([Source("source", float), Integrator("plant")], connection)


def test_input_is_driven_once_only():
    sources = [Source("a", float), Source("b", float), Integrator("plant")]
    with pytest.raises(InputError, match=r"b.y → plant.u: plant.u is driven by a.y already; remove one"):
        graph(sources, "a.y > plant.u", "b.y > plant.u")


def test_all_mistakes_are_told_at_once():
    with pytest.raises(InputError) as caught:
        graph([Gain("a"), Gain("b")], "a.x > b.u", "a.y > b.w", "c.y > a.u")
    assert len(str(caught.value).splitlines()) == 3


@pytest.mark.parametrize(
    ("source", "target", "fits"),
    [
        ("Real", "Real", True),
        ("Integer", "Real", True),
        ("Boolean", "Integer", True),
        ("Integer", "Enumeration", True),
        ("Real", "Integer", False),
        ("Integer", "Boolean", False),
        ("Real", "Boolean", False),
        ("Boolean", "Enumeration", False),
    ],
)
def test_types_must_fit_without_loss(source: str, target: str, fits: bool):
    components = [
        Small("a", Variable("y", "output", type=source)),
        Small("b", Variable("u", "input", type=target)),
    ]
    if fits:
        assert len(graph(components, "a.y > b.u").connections) == 1
    else:
        with pytest.raises(InputError, match=f"types do not fit, {source} into {target}"):
            graph(components, "a.y > b.u")
