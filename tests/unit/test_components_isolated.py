"""Components in a process of their own: the same results, and an error that names whatever they do."""

from __future__ import annotations

import gc
import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from fmu_helpers import TYPES_3, Driver, probe

from exlinn_fmi.components import process, texts, worker
from exlinn_fmi.components.base import Component, Status, Variable
from exlinn_fmi.components.fmu import FmuComponent
from exlinn_fmi.components.isolated import IsolatedComponent, isolated_fmu
from exlinn_fmi.components.python import PythonComponent
from exlinn_fmi.errors import ComponentError, FmuError, InputError


def isolated(path: Path, timeout: float = 20.0, memory: float | None = None) -> IsolatedComponent:
    return isolated_fmu("probe", path, timeout, memory)


def children() -> list[int]:
    """Processes that this one has, dead ones that nobody has waited for included."""
    own = Path(f"/proc/{os.getpid()}/task")
    return [int(pid) for task in own.iterdir() for pid in (task / "children").read_text().split()]


@pytest.fixture(autouse=True)
def nothing_left() -> Iterator[set[int]]:
    """Every test ends without processes and open files of its own; gives those that other tests have left."""
    before, files = set(children()), sum(1 for _ in Path("/proc/self/fd").iterdir())
    yield before
    gc.collect()
    assert set(children()) == before
    assert sum(1 for _ in Path("/proc/self/fd").iterdir()) <= files


# ── the same as in this process ──────────────────────────────────────────────────────────────────────────


def history(component: Component, inputs: list[str], outputs: list[str]) -> list[float]:
    driver = Driver(component).begin(gain=1.5, x=-0.25)
    values = []
    for k in range(30):
        driver.set(**{name: (k * 0.37) % 3 if name == "u" else k % 2 for name in inputs})
        values += driver.get(*outputs)
        assert driver.step() == Status.OK
    values += driver.get(*outputs)
    component.close()
    return values


def test_results_are_those_of_the_same_process_to_the_last_bit(tmp_path: Path) -> None:
    path = probe(tmp_path)
    names = ["u", "n_in", "on"], ["x", "y", "n_out", "off"]
    assert history(isolated(path), *names) == history(FmuComponent("probe", path), *names)


def test_results_of_fmi3_are_those_of_the_same_process(tmp_path: Path) -> None:
    path = probe(tmp_path, version=3)
    names = (
        ["u", *(f"{kind}_in" for kind in TYPES_3)],
        ["x", "y", *(f"{kind}_out" for kind in TYPES_3)],
    )
    assert history(isolated(path), *names) == history(FmuComponent("probe", path), *names)


def test_a_second_run_begins_afresh(tmp_path: Path) -> None:
    driver = Driver(isolated(probe(tmp_path)))
    for _ in range(2):
        driver.begin(x=1.0)
        driver.set(u=1.0)
        driver.run(5)
        assert driver.get("x") == pytest.approx([1.5])
    driver.component.close()
    driver.component.close()


def test_inputs_set_one_after_the_other_are_all_set(tmp_path: Path) -> None:
    driver = Driver(isolated(probe(tmp_path))).begin()
    driver.set(u=1.0)
    driver.set(trim=0.5)
    driver.set(n_in=6)
    assert driver.get("y", "n_out") == [2.5, 7.0]
    for k in range(50):  # inputs of the next step are not taken for those of one that is still going on
        driver.set(u=float(k))
        driver.step()
    assert driver.get("x") == pytest.approx([0.1 * sum(range(50))])
    driver.component.close()


def test_a_restored_state_gives_the_same_future(tmp_path: Path) -> None:
    driver = Driver(isolated(probe(tmp_path))).begin()
    assert driver.component.can_save_state
    driver.set(u=1.0)
    driver.run(3)
    state, ticks = driver.component.save_state(), driver.ticks
    futures = []
    for _ in range(2):
        driver.component.restore_state(state)
        driver.ticks = ticks
        driver.run(4)
        futures.append(driver.get("x", "y"))
    assert futures[0] == futures[1] == pytest.approx([0.7, 2.7])
    for _ in range(3):
        driver.component.save_state()  # frees those dropped before
    driver.component.close()


def test_start_values_that_are_not_taken_are_refused_as_in_this_process(tmp_path: Path) -> None:
    component = isolated(probe(tmp_path))
    with pytest.raises(InputError, match=r"probe\.gian: no such variable; did you mean 'gain'"):
        component.enter_initialization(0.0, 1.0, {"gian": 1.0})
    component.close()


@pytest.mark.parametrize("define", ["REFUSE", "LACKING"])
def test_an_fmu_that_cannot_be_used_is_told_as_in_this_process(tmp_path: Path, define: str) -> None:
    path = probe(tmp_path, define)
    with pytest.raises(FmuError) as here:
        FmuComponent("probe", path)
    with pytest.raises(FmuError) as there:
        isolated(path)
    assert str(here.value) == str(there.value)


def test_more_sets_of_variables_than_the_memory_holds_are_no_trouble(tmp_path: Path) -> None:
    driver = Driver(isolated(probe(tmp_path))).begin()
    component = driver.component
    y = component.index("y")
    for k in range(1, 130):
        driver.set(u=float(k))
        values = np.zeros(40 + k)
        assert component.get(np.full(40 + k, y), values) == Status.OK
        assert set(values) == {2.0 * k}
    component.close()


def test_processes_know_how_many_they_are(tmp_path: Path) -> None:
    path = probe(tmp_path)
    components = [isolated(path) for _ in range(3)]
    blocks = [component._process.block for component in components]
    assert [block[worker.OTHERS] for block in blocks] == [3, 3, 3]
    components[1].close()
    assert [blocks[k][worker.OTHERS] for k in (0, 2)] == [2, 2]
    for component in components:
        component.close()


def test_what_an_fmu_prints_does_not_disturb(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = probe(tmp_path, 'HARM=printf("hello"); fflush(stdout)', "HARM_IN=GET")
    driver = Driver(isolated(path)).begin()
    driver.run(6)
    assert driver.get("x") == [0.0]
    driver.component.close()
    assert "hello" in capfd.readouterr().err


class Stubborn(PythonComponent):
    """A component in Python that raises."""

    def __init__(self, name: str) -> None:
        super().__init__(name, (Variable("y", "output"),))

    def advance(self, t: float, h: float) -> None:
        raise ValueError("no more")


def test_any_component_can_be_isolated_and_its_exceptions_are_told() -> None:
    made = Stubborn("stubborn")
    component = IsolatedComponent("stubborn", made.variables, f"{__name__}:Stubborn", {"name": "stubborn"})
    driver = Driver(component).begin()
    driver.step()
    with pytest.raises(
        ComponentError, match=r"^stubborn at t = 0 s: the step ended with status ERROR: .*no more"
    ):
        driver.get("y")
    component.close()


class Square(PythonComponent):
    """y = u² + x, x' = u, with all that the contract offers."""

    variables = (Variable("u", "input"), Variable("y", "output"), Variable("x", "output", start=0.0))

    def outputs(self, t: float) -> None:
        self["y"] = self["u"] ** 2 + self["x"]

    def advance(self, t: float, h: float) -> None:
        self["x"] += h * (self["u"] + self.slope * h / 2)

    slope = 0.0
    gives_directional_derivatives = True
    takes_input_derivatives = True

    def directional_derivative(self, unknowns, knowns, seed):
        assert unknowns.tolist() == [1]
        assert knowns.tolist() == [0]
        return 2 * self["u"] * seed

    def set_input_derivatives(self, indices, derivatives):
        self.slope = float(derivatives[0])
        return Status.OK


@pytest.mark.parametrize("apart", [True, False])
def test_all_that_a_component_offers_is_offered(apart: bool, request: pytest.FixtureRequest) -> None:
    if not apart:
        request.getfixturevalue("within")
    one, other = (
        Driver(IsolatedComponent("s", Square.variables, f"{__name__}:Square", {"name": "s"})).begin()
        for _ in range(2)
    )
    component = one.component
    assert component.can_serialize_state
    assert component.gives_directional_derivatives
    assert component.takes_input_derivatives
    one.set(u=3.0)
    derivative = component.directional_derivative(np.array([1]), np.array([0]), np.array([0.5]))
    assert derivative.tolist() == [3.0]  # with the input that was set just before
    assert component.set_input_derivatives(np.array([0]), np.array([2.0])) == Status.OK
    one.step()
    assert one.get("x") == pytest.approx([0.1 * 3 + 2 * 0.01 / 2])
    data = component.serialize_state(component.save_state())
    assert isinstance(data, bytes)
    other.component.restore_state(other.component.deserialize_state(data))
    assert other.get("x", "y") == one.get("x", "y")
    for driver in (one, other):
        driver.component.close()


class Backwards(PythonComponent):
    """Texts and binaries turned round; other numbers stand for them in this process than in its own."""

    def __init__(self, name: str) -> None:
        texts.handle(f"only here: {os.getpid()}")
        kinds = ("String", "Binary")
        inputs = [Variable(f"{kind}_in", "input", "discrete", type=kind, start=0.0) for kind in kinds]
        outputs = [Variable(f"{kind}_out", "output", "discrete", type=kind) for kind in kinds]
        super().__init__(name, [*inputs, *outputs, Variable("pid", "output", "discrete")])

    def outputs(self, t: float) -> None:
        for kind in ("String", "Binary"):
            self[f"{kind}_out"] = texts.handle(texts.text(self[f"{kind}_in"])[::-1])
        self["pid"] = os.getpid()


@pytest.mark.parametrize("apart", [True, False])
def test_texts_mean_the_same_in_both_processes(apart: bool, request: pytest.FixtureRequest) -> None:
    if not apart:
        request.getfixturevalue("within")
    made = Backwards("b")
    for k in range(5):
        texts.handle(f"{k} {time.monotonic()}")  # numbers that the other process does not have
    component = IsolatedComponent("b", made.variables, f"{__name__}:Backwards", {"name": "b"})
    driver = Driver(component).begin()
    assert (driver.get("pid") == [os.getpid()]) != apart
    for word in ("Motor", "läuft", "", "Motor"):
        driver.set(String_in=texts.handle(word), Binary_in=texts.handle(word.encode()))
        assert [texts.text(n) for n in driver.get("String_out", "Binary_out")] == [
            word[::-1],
            word.encode()[::-1],
        ]
        driver.step()
    driver.begin(String_in=texts.handle("again"))
    assert texts.text(driver.get("String_out")[0]) == "niaga"
    component.close()


# ── the worker, seen from inside ─────────────────────────────────────────────────────────────────────────


class Within:
    """The other end in a thread of this process, so that what it does can be measured and debugged."""

    def __init__(self, size: int, timeout: float, memory: float | None) -> None:
        self.block, self.alive, self.timeout = np.zeros(size // 8), True, timeout
        (theirs, self._requests), (self._replies, mine) = os.pipe(), os.pipe()
        self._pipes = [theirs, self._requests, self._replies, mine]
        serve = worker.Worker(self.block, theirs, mine).serve
        self._thread = threading.Thread(target=serve)
        self._thread.start()

    def send(self, data: bytes) -> None:
        os.write(self._requests, data)

    def receive(self, size: int) -> bytes:
        return os.read(self._replies, size)

    def end(self, patience: float = 0.0) -> None:
        if self.alive:
            self.alive = False
            os.close(self._requests)
            self._thread.join()
            for pipe in set(self._pipes) - {self._requests}:
                os.close(pipe)


@pytest.fixture
def within(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("exlinn_fmi.components.isolated.Process", Within)
    for name in ("watch_parent", "_limit"):  # they are about a process of its own
        monkeypatch.setattr(worker, name, lambda *_: None)


@pytest.mark.usefixtures("within")
def test_the_worker_does_what_the_component_would(tmp_path: Path) -> None:
    path = probe(tmp_path)
    names = ["u", "n_in", "on"], ["x", "y", "n_out", "off"]
    assert history(isolated(path), *names) == history(FmuComponent("probe", path), *names)
    driver = Driver(isolated(path)).begin()
    state = driver.component.save_state()
    driver.run(3)
    driver.component.restore_state(state)
    del state
    driver.component.save_state()
    driver.ticks = 0
    driver.set(n_in=1.5)
    assert driver.step() == Status.ERROR
    for k in range(130):
        assert driver.component.get(np.full(40 + k, 2), np.zeros(40 + k)) == Status.OK
    with pytest.raises(InputError, match="did you mean 'gain'"):
        driver.component.enter_initialization(0.0, 1.0, {"gian": 1.0})
    driver.component.close()


@pytest.mark.usefixtures("within")
@pytest.mark.parametrize("word", ["Warning", "Error"])
def test_the_worker_tells_what_a_step_said(tmp_path: Path, word: str) -> None:
    driver = Driver(isolated(probe(tmp_path, f"FAULT=fmi2{word}"))).begin()
    driver.run(5)
    values = np.zeros(1)
    where = np.array([driver.component.index("x")])
    if word == "Warning":
        assert driver.component.get(where, values) == Status.WARNING
        assert "the bearing is hot" in driver.component.message
    else:
        with pytest.raises(ComponentError, match=r"at t = 0\.4 s: the step ended with status ERROR"):
            driver.component.get(where, values)
    driver.component.close()


@pytest.mark.usefixtures("within")
def test_the_worker_ends_with_its_pipe(tmp_path: Path) -> None:
    component = isolated(probe(tmp_path))
    component._process.end()
    component.close()


@pytest.mark.usefixtures("within")
def test_the_worker_tells_what_a_step_raised() -> None:
    made = Stubborn("stubborn")
    component = IsolatedComponent("stubborn", made.variables, f"{__name__}:Stubborn", {"name": "stubborn"})
    driver = Driver(component).begin()
    driver.step()
    with pytest.raises(ComponentError, match="no more"):
        driver.get("y")
    component.close()


# ── statuses ─────────────────────────────────────────────────────────────────────────────────────────────


def test_a_step_that_fails_is_told_by_the_next_call_with_its_time(tmp_path: Path) -> None:
    driver = Driver(isolated(probe(tmp_path, "FAULT=fmi2Error"))).begin()
    driver.run(5)
    with pytest.raises(ComponentError) as error:
        driver.get("x")
    words = "the step ended with status ERROR: fmi2DoStep returned fmi2Error: the bearing is hot at t = 0.5 s"
    assert str(error.value) == f"probe at t = 0.4 s: {words}"
    driver.component.close()


def test_a_step_that_may_be_undone_tells_its_own_status(tmp_path: Path) -> None:
    driver = Driver(isolated(probe(tmp_path, "FAULT=fmi2Discard"))).begin()
    driver.component.save_state()
    driver.run(4)
    assert driver.step() == Status.DISCARD
    assert "the FMU asks to end the simulation" in driver.component.message
    driver.component.close()


def test_a_warning_of_a_step_is_told_by_the_next_call(tmp_path: Path) -> None:
    driver = Driver(isolated(probe(tmp_path, "FAULT=fmi2Warning"))).begin()
    driver.run(5)
    values = np.zeros(1)
    assert driver.component.get(np.array([driver.component.index("x")]), values) == Status.WARNING
    assert "the bearing is hot" in driver.component.message
    assert driver.get("x") == [0.0]
    driver.component.close()


def test_an_input_that_is_refused_is_told_with_the_next_call(tmp_path: Path) -> None:
    driver = Driver(isolated(probe(tmp_path))).begin()
    driver.set(n_in=1.5)
    values = np.zeros(1)
    assert driver.component.get(np.array([driver.component.index("x")]), values) == Status.ERROR
    assert driver.component.message == "n_in is of type Integer: cannot be 1.5"
    driver.component.close()


# ── harm ─────────────────────────────────────────────────────────────────────────────────────────────────


HARM = {
    "raise(SIGSEGV)": "its process was ended by SIGSEGV, Segmentation fault,",
    "*(volatile int*)0 = 1": "its process was ended by SIGSEGV, Segmentation fault,",
    "abort()": "its process was ended by SIGABRT, Aborted,",
    "exit(0)": "its process ended with exit code 0",
    "_exit(7)": "its process ended with exit code 7",
    "{ char start; deeper(&start); }": "its process was ended by SIGSEGV, Segmentation fault,",
    "pthread_exit(0)": "its process ended with exit code|no answer within",
    "kill(getpid(), SIGKILL)": "its process was ended by SIGKILL, Killed, perhaps for lack of memory,",
    "for (;;)": "no answer within 0.7 s, so its process was ended,",
    "for (;;) pause()": "no answer within 0.7 s, so its process was ended,",
    "raise(SIGSTOP)": "no answer within 0.7 s, so its process was ended,",
    "{ signal(SIGTERM, SIG_IGN); for (;;); }": "no answer within 0.7 s, so its process was ended,",
    "{ for (int k = 0; k < 64; k++) close(k); }": "its process (ended with exit code|was ended by)",
    "if (!fork()) for (;;) pause(); else abort()": "its process was ended by SIGABRT|no answer within 0.7 s",
    'printf("%0*d", 70000, 1); abort()': "its process was ended by SIGABRT",
}


def run_until_harm(path: Path, **options: float) -> ComponentError:
    """What comes of running a probe that does harm; within twice its timeout, and it stays dead."""
    began = time.monotonic()
    with pytest.raises(ComponentError) as error:  # noqa: PT012 - where it comes depends on the place
        component = isolated(path, **options)
        try:
            driver = Driver(component).begin()
            for k in range(12):
                driver.set(u=0.1 * k)
                driver.get("y")
                driver.step()
        finally:
            component.close()
    assert time.monotonic() - began < 8
    return error.value


@pytest.mark.parametrize("harm", HARM)
def test_whatever_a_step_does_is_an_error_with_its_name_and_time(tmp_path: Path, harm: str) -> None:
    error = run_until_harm(probe(tmp_path, f"HARM={harm}", "HARM_IN=STEP"), timeout=0.7)
    assert error.component == "probe"
    assert error.time == pytest.approx(0.4)
    text = str(error).removeprefix("probe at t = 0.4 s: ")
    expected = HARM[harm]
    assert any(text.startswith(words) for words in expected.split("|")) or "(" in expected, text
    assert text.endswith(" in the step")


@pytest.mark.parametrize(
    ("place", "call", "when"),
    [
        ("INSTANTIATE", "instantiation", None),
        ("INITIALIZE", "initialisation", 0.0),
        ("GET", "reading outputs", 0.5),
        ("SET", "setting inputs", 0.5),
    ],
)
@pytest.mark.parametrize("harm", ["abort()", "exit(0)", "for (;;)"])
def test_harm_elsewhere_is_told_with_its_place(
    tmp_path: Path, harm: str, place: str, call: str, when: float | None
) -> None:
    error = run_until_harm(probe(tmp_path, f"HARM={harm}", f"HARM_IN={place}"), timeout=0.7)
    assert str(error).endswith(f" in {call}")
    assert error.time == (when if when is None else pytest.approx(when))


@pytest.mark.parametrize("harm", ["abort()", "for (;;)"])
def test_harm_in_closing_is_told_and_ends_the_process(tmp_path: Path, harm: str) -> None:
    component = isolated(probe(tmp_path, f"HARM={harm}", "HARM_IN=FREE"), timeout=0.7)
    Driver(component).begin().run(3)
    with pytest.raises(ComponentError, match=r"in closing$"):
        component.close()


def test_memory_without_end_is_bounded(tmp_path: Path) -> None:
    path = probe(tmp_path, "HARM=swell()", "HARM_IN=STEP")
    error = run_until_harm(path, memory=2e8)
    assert "was ended by SIGSEGV, Segmentation fault (of memory it may take 200 MB), in the step" in str(
        error
    )


def test_calls_after_the_end_tell_it_again(tmp_path: Path) -> None:
    driver = Driver(isolated(probe(tmp_path, "HARM=abort()", "HARM_IN=STEP"))).begin()
    driver.run(5)
    for call in (lambda: driver.get("x"), lambda: driver.get("y"), driver.step, driver.begin):
        with pytest.raises(ComponentError, match="SIGABRT"):
            call()
    driver.component.close()


def test_a_component_that_is_dropped_ends_its_process(tmp_path: Path, nothing_left: set[int]) -> None:
    component = isolated(probe(tmp_path))
    assert len(set(children()) - nothing_left) == 1
    del component
    gc.collect()
    assert set(children()) == nothing_left


def test_a_process_that_others_end_is_told(tmp_path: Path, nothing_left: set[int]) -> None:
    driver = Driver(isolated(probe(tmp_path))).begin()
    (worker,) = set(children()) - nothing_left
    os.kill(worker, signal.SIGKILL)
    with pytest.raises(ComponentError, match="SIGKILL"):
        driver.get("x")
    driver.component.close()


def test_ctrl_c_while_waiting_leaves_nothing(tmp_path: Path) -> None:
    driver = Driver(isolated(probe(tmp_path, "HARM=for (;;)", "HARM_IN=STEP"))).begin()
    driver.run(5)
    threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
    with pytest.raises(KeyboardInterrupt):
        driver.get("x")
    driver.component.close()


def test_without_pipes_that_can_be_waited_for_a_timer_watches(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(process, "POLLS", False)  # as on Windows
    path = probe(tmp_path, "HARM=for (;;)", "HARM_IN=STEP")
    assert "no answer within 0.5 s" in str(run_until_harm(path, timeout=0.5))


@pytest.mark.parametrize("harm", ["for (;;)", "for (;;) pause()"])
@pytest.mark.parametrize("place", ["INSTANTIATE", "STEP"])
def test_a_killed_parent_leaves_no_process_and_no_file(tmp_path: Path, harm: str, place: str) -> None:
    path = probe(tmp_path, f"HARM={harm}", f"HARM_IN={place}")
    script = f"""
        import sys
        sys.path[:0] = {[str(folder) for folder in Path(__file__).parents[:2]]}
        from pathlib import Path
        from test_components_isolated import Driver, isolated
        print("begin", flush=True)
        driver = Driver(isolated(Path({str(path)!r}), 60.0)).begin()
        driver.run(5)
        driver.get("x")
    """
    memory = set(Path("/dev/shm").iterdir())
    mark = f"EXLINN_MARK={tmp_path}"
    environment = os.environ | {"EXLINN_MARK": str(tmp_path)}
    parent = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(script)], stdout=subprocess.PIPE, env=environment
    )
    assert parent.stdout is not None
    assert parent.stdout.readline() == b"begin\n"
    wait_until(lambda: len(marked(mark)) == 2, 10)
    time.sleep(0.7)  # until the worker is in the loop
    assert len(marked(mark)) == 2
    parent.kill()
    parent.wait()
    parent.stdout.close()
    wait_until(lambda: not marked(mark), 5)
    assert set(Path("/dev/shm").iterdir()) == memory


def marked(mark: str) -> list[int]:
    """Living processes that have this in their environment."""
    found = []
    for folder in Path("/proc").iterdir():
        try:
            if folder.name.isdigit() and mark.encode() in (folder / "environ").read_bytes().split(b"\0"):
                found.append(int(folder.name))
        except OSError:
            continue
    return found


def wait_until(done, seconds: float) -> None:
    end = time.monotonic() + seconds
    while not done():
        assert time.monotonic() < end, "that never came"
        time.sleep(0.02)
