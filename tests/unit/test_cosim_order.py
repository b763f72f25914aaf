"""Laws of the order of values, on random wirings without components behind them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from exlinn_fmi.cosim.order import Broken, Edge, Port, Visit, Wiring, break_loops, visits

# beartype draws at random which entries of a wiring it checks; nothing of what is tested depends on it.
pytestmark = pytest.mark.filterwarnings("ignore:Do not use the `random` module")

COUNT, INPUTS, OUTPUTS = 4, 3, 3


@st.composite
def wirings(draw: st.DrawFn, declared: bool = True, unknown: bool = True) -> Wiring:
    """Up to 4 components with inputs 0…2 and outputs 3…5, connected and fed through at random."""
    outputs = [(c, INPUTS + k) for c in range(COUNT) for k in range(OUTPUTS)]
    inputs = [(c, k) for c in range(COUNT) for k in range(INPUTS)]
    chosen = draw(st.lists(st.sampled_from(inputs), unique=True, max_size=10))
    connections = tuple((draw(st.sampled_from(outputs)), i) for i in chosen)
    feeds: dict[str, dict[Port, set[Port]]] = {"declared": {}, "unknown": {}}
    for o in {o for o, _ in connections}:
        own = {i for i in chosen if i[0] == o[0]}
        if unknown and draw(st.booleans()):
            feeds["unknown"][o] = own
        elif declared:
            feeds["declared"][o] = (
                set(draw(st.lists(st.sampled_from(sorted(own)), unique=True))) if own else set()
            )
    return Wiring(connections, **feeds, sampled=draw(st.lists(st.booleans(), min_size=COUNT, max_size=COUNT)))


def dependencies(wiring: Wiring) -> list[Edge]:
    both = [*wiring.declared.items(), *wiring.unknown.items()]
    return [(i, o) for o, inputs in both for i in inputs]


def places(plan: list[Visit]) -> tuple[dict[Port, int], dict[Port, int]]:
    """At which visit each input is set and each output is got; each once."""
    sets = [((v.component, k), n) for n, v in enumerate(plan) for k in v.inputs]
    gets = [((v.component, k), n) for n, v in enumerate(plan) for k in v.outputs]
    assert len(dict(sets)) == len(sets)
    assert len(dict(gets)) == len(gets)
    return dict(sets), dict(gets)


def loops_by_scipy(edges: list[Edge]) -> set[tuple[Port, ...]]:
    ports = sorted({port for edge in edges for port in edge})
    number = {port: k for k, port in enumerate(ports)}
    rows, columns = [number[a] for a, _ in edges], [number[b] for _, b in edges]
    matrix = coo_array((np.ones(len(edges)), (rows, columns)), shape=(len(ports), len(ports)))
    _, labels = connected_components(matrix, connection="strong")
    groups = [tuple(p for p, label in zip(ports, labels, strict=True) if label == n) for n in set(labels)]
    return {group for group in groups if len(group) > 1}


@given(wirings())
def test_every_value_is_got_before_it_is_passed_on(wiring: Wiring):
    broken = break_loops(wiring)
    sets, gets = places(visits(COUNT, wiring, broken))
    assert all(gets[o] < sets[i] for o, i in wiring.connections if (o, i) not in broken.delayed)


@given(wirings())
def test_every_input_is_set_before_an_output_that_depends_on_it_is_got(wiring: Wiring):
    broken = break_loops(wiring)
    sets, gets = places(visits(COUNT, wiring, broken))
    assert all(sets[i] <= gets[o] for i, o in dependencies(wiring) if (i, o) not in broken.assumed)


@given(wirings())
def test_every_connected_port_is_visited_once(wiring: Wiring):
    sets, gets = places(visits(COUNT, wiring, break_loops(wiring)))
    assert set(sets) == {i for _, i in wiring.connections}
    assert set(gets) == {o for o, _ in wiring.connections}


@given(wirings())
def test_every_component_has_one_last_visit_after_all_its_others(wiring: Wiring):
    plan = visits(COUNT, wiring, break_loops(wiring))
    for component in range(COUNT):
        lasts = [v.last for v in plan if v.component == component]
        assert lasts[-1]
        assert sum(lasts) == 1


@given(wirings(unknown=False))
def test_algebraic_loops_are_the_strong_components_of_declared_feed_through(wiring: Wiring):
    broken = break_loops(wiring)
    edges = [*wiring.connections, *dependencies(wiring)]
    assert set(broken.loops) == (loops_by_scipy(edges) if edges else set())
    assert bool(broken.delayed) == bool(broken.loops)


@given(wirings())
def test_only_connections_within_algebraic_loops_are_delayed(wiring: Wiring):
    broken = break_loops(wiring)
    assert all(any(o in loop and i in loop for loop in broken.loops) for o, i in broken.delayed)


@given(wirings(declared=False))
def test_loops_through_unknown_dependencies_cost_no_connection(wiring: Wiring):
    broken = break_loops(wiring)
    assert not broken.delayed
    assert not broken.loops


@given(wirings(), st.randoms())
def test_order_of_connections_and_dependencies_does_not_matter(wiring: Wiring, random):
    def shuffled(things):
        things = list(things)
        random.shuffle(things)
        return things

    other = Wiring(
        tuple(shuffled(wiring.connections)),
        dict(shuffled(wiring.declared.items())),
        dict(shuffled(wiring.unknown.items())),
        wiring.sampled,
    )
    assert break_loops(other) == break_loops(wiring)
    assert visits(COUNT, other, break_loops(other)) == visits(COUNT, wiring, break_loops(wiring))


@given(wirings(), st.permutations(range(COUNT)))
def test_numbers_of_components_do_not_decide_whether_there_are_loops(wiring: Wiring, new: list[int]):
    def moved(port: Port) -> Port:
        return new[port[0]], port[1]

    other = Wiring(
        tuple((moved(o), moved(i)) for o, i in wiring.connections),
        {moved(o): set(map(moved, inputs)) for o, inputs in wiring.declared.items()},
        {moved(o): set(map(moved, inputs)) for o, inputs in wiring.unknown.items()},
        [wiring.sampled[new.index(c)] for c in range(COUNT)],
    )
    here, there = break_loops(wiring), break_loops(other)
    assert {tuple(sorted(map(moved, loop))) for loop in here.loops} == set(there.loops)
    if not here.loops:
        assert bool(here.assumed) == bool(there.assumed)


def test_ring_of_a_thousand_static_components_is_one_loop_with_one_delay():
    n = 1000
    ring = tuple(((c, 1), ((c + 1) % n, 0)) for c in range(n))
    wiring = Wiring(ring, {(c, 1): {(c, 0)} for c in range(n)}, {}, [False] * n)
    broken = break_loops(wiring)
    assert len(broken.loops) == 1
    assert broken.delayed == (((n - 1, 1), (0, 0)),)
    assert visits(n, wiring, broken) == [Visit(c, (0,), (1,), True) for c in range(n)]


@pytest.mark.parametrize(
    ("sampled", "delayed"), [((False, True), 1), ((True, False), 0), ((False, False), 0)]
)
def test_algebraic_loop_breaks_into_a_sampled_component_else_back_to_the_first(
    sampled: tuple[bool, bool], delayed: int
):
    pair = (((0, 1), (1, 0)), ((1, 1), (0, 0)))
    wiring = Wiring(pair, {(0, 1): {(0, 0)}, (1, 1): {(1, 0)}}, {}, sampled)
    assert break_loops(wiring).delayed == (next(c for c in pair if c[1][0] == delayed),)


@pytest.mark.parametrize(("sampled", "opened"), [((False, False), 0), ((True, False), 1), ((True, True), 0)])
def test_unknown_loop_opens_at_the_first_component_that_is_not_sampled(
    sampled: tuple[bool, bool], opened: int
):
    pair = (((0, 1), (1, 0)), ((1, 1), (0, 0)))
    wiring = Wiring(pair, {}, {(0, 1): {(0, 0)}, (1, 1): {(1, 0)}}, sampled)
    assert break_loops(wiring) == Broken((), (), (((opened, 0), (opened, 1)),))


def test_declared_loop_beside_an_unknown_one_is_broken_first():
    # Component 0 feeds itself by declaration; its unknown output closes a second loop through component 1.
    connections = (((0, 2), (0, 0)), ((0, 3), (1, 0)), ((1, 1), (0, 1)))
    wiring = Wiring(connections, {(0, 2): {(0, 0)}, (1, 1): {(1, 0)}}, {(0, 3): {(0, 1)}}, [False, False])
    broken = break_loops(wiring)
    assert broken.delayed == (((0, 2), (0, 0)),)
    assert broken.assumed == (((0, 1), (0, 3)),)
