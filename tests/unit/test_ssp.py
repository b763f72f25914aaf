"""Systems of SSP, read, run and written: nesting, units, transformations, dictionaries, parameters, harm."""

from __future__ import annotations

import contextlib
import zipfile
from pathlib import Path
from random import Random
from typing import Any

import pandas as pd
import pytest
from fmu_helpers import description_2, pack, probe
from hypothesis import given, settings
from hypothesis import strategies as st

from exlinn_fmi import cli
from exlinn_fmi.errors import ScenarioError
from exlinn_fmi.factory import inspect
from exlinn_fmi.scenario.load import LoadedScenario, load_scenario
from exlinn_fmi.scenario.schema import FmuComponent

SPACES = " ".join(
    f'xmlns:{prefix}="http://ssp-standard.org/SSP1/SystemStructure{name}"'
    for prefix, name in (
        ("ssd", "Description"),
        ("ssc", "Common"),
        ("ssv", "ParameterValues"),
        ("ssm", "ParameterMapping"),
        ("ssb", "SignalDictionary"),
    )
)
UNITS = """<ssd:Units>
<ssc:Unit name="m/s"><ssc:BaseUnit m="1" s="-1"/></ssc:Unit>
<ssc:Unit name="km/h"><ssc:BaseUnit m="1" s="-1" factor="0.2777777777777778"/></ssc:Unit>
<ssc:Unit name="m"><ssc:BaseUnit m="1"/></ssc:Unit></ssd:Units>"""


def connector(name: str, kind: str, unit: str = "") -> str:
    real = f'<ssc:Real unit="{unit}"/>' if unit else "<ssc:Real/>"
    return f'<ssd:Connector name="{name}" kind="{kind}">{real}</ssd:Connector>'


def fmu(name: str, extra: str = "", unit: str = "m/s", source: str = "resources/Probe.fmu") -> str:
    connectors = connector("u", "input", unit) + connector("x", "output", "m") + connector("y", "output")
    return (
        f'<ssd:Component name="{name}" type="application/x-fmu-sharedlibrary" source="{source}">'
        f"<ssd:Connectors>{connectors}</ssd:Connectors>{extra}</ssd:Component>"
    )


def connection(start: str, end: str, inner: str = "", **attributes: str) -> str:
    text = "".join(f' {key}="{value}"' for key, value in attributes.items())
    for side, path in (("start", start), ("end", end)):
        element, _, name = path.rpartition(".")
        text += f' {side}Element="{element}"' * bool(element) + f' {side}Connector="{name}"'
    return f"<ssd:Connection{text}>{inner}</ssd:Connection>"


def system(elements: str, connections: str = "", head: str = "", name: str = "top", tail: str = "") -> str:
    return (
        f'<ssd:System name="{name}">{head}<ssd:Elements>{elements}</ssd:Elements>'
        f"<ssd:Connections>{connections}</ssd:Connections>{tail}</ssd:System>"
    )


def structure(inner: str, version: str = "1.0", rest: str = "") -> str:
    return (
        f'<ssd:SystemStructureDescription {SPACES} version="{version}" name="two probes">{inner}{UNITS}'
        f'<ssd:DefaultExperiment startTime="0" stopTime="2"/>{rest}</ssd:SystemStructureDescription>'
    )


def parameters(values: dict[str, Any], mapping: str = "", units: str = "", **attributes: str) -> str:
    text = "".join(f' {key}="{value}"' for key, value in attributes.items())
    entries = ""
    for name, value in values.items():
        kind = {bool: "Boolean", int: "Integer", float: "Real"}[type(value)]
        shown = str(value).lower() if kind == "Boolean" else value
        unit = f' unit="{units}"' * bool(units)
        entries += f'<ssv:Parameter name="{name}"><ssv:{kind} value="{shown}"{unit}/></ssv:Parameter>'
    return (
        f"<ssd:ParameterBindings><ssd:ParameterBinding{text}><ssd:ParameterValues>"
        f'<ssv:ParameterSet version="1.0" name="set"><ssv:Parameters>{entries}</ssv:Parameters>'
        f"{UNITS.replace('ssd:', 'ssv:')}"
        f"</ssv:ParameterSet></ssd:ParameterValues>{mapping}</ssd:ParameterBinding></ssd:ParameterBindings>"
    )


def package(folder: Path, text: str, **more: str | bytes) -> Path:
    """A package with the probe FMU in it."""
    content = probe(folder).read_bytes()
    members = {"SystemStructure.ssd": text, "resources/Probe.fmu": content}
    return pack(
        folder / "system.ssp", members | {name.replace("__", "/"): data for name, data in more.items()}
    )


def load(file: Path) -> LoadedScenario:
    return load_scenario(file, (), inspect)


def links(file: Path) -> dict[str, tuple[str, float, float, bool]]:
    found = {}
    for source, link in load(file).scenario.links():
        found[f"{source} {link.to}"] = (
            pytest.approx(link.factor),
            pytest.approx(link.offset),
            link.convert,
        )
    return found


def starts(file: Path) -> dict[str, dict[str, Any]]:
    return {name: dict(spec.start) for name, spec in load(file).scenario.components.items() if spec.start}


# ── systems and connections ──────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("version", ["1.0", "2.0"])
def test_a_package_is_read_and_run(tmp_path: Path, version: str) -> None:
    gain = parameters({"gain": 0.0, "u": 2.0})
    text = structure(
        system(fmu("a", gain) + fmu("b"), connection("a.x", "b.u", suppressUnitConversion="true"))
    )
    file = package(tmp_path, text.replace('version="1.0" name="two', f'version="{version}" name="two'))
    loaded = load(file)
    assert loaded.scenario.name == "two_probes"
    assert list(loaded.scenario.components) == ["a", "b"]
    spec = loaded.scenario.components["a"]
    assert isinstance(spec, FmuComponent)
    assert spec.isolate
    out = tmp_path / "run"
    assert cli.exit_code(["run", str(file), "--out", str(out), "--set", "simulate.step=0.1"]) == 0
    table = pd.read_csv(out / "trajectories.csv")
    assert table["a.x"].iloc[-1] == pytest.approx(4.0)
    assert table["b.u"].equals(table["a.x"])
    assert table["b.x"].iloc[-1] == pytest.approx(0.1 * sum(0.2 * k for k in range(20)))


def test_a_description_beside_its_files_is_read(tmp_path: Path) -> None:
    (tmp_path / "resources").mkdir()
    probe(tmp_path / "resources")
    (tmp_path / "x.ssd").write_text(structure(system(fmu("a"))))
    loaded = load(tmp_path / "x.ssd")
    assert loaded.scenario.components["a"].isolate is None
    assert loaded.scenario.simulate.stop == 2.0
    assert loaded.scenario.simulate.step == 0.002


def test_ends_may_stand_either_way_round(tmp_path: Path) -> None:
    text = structure(
        system(
            fmu("a") + fmu("b"),
            connection("b.u", "a.y", suppressUnitConversion="1") + connection("b.y", "a.u"),
        )
    )
    assert set(links(package(tmp_path, text))) == {"a.y b.u", "b.y a.u"}


def test_units_are_converted_and_transformations_follow(tmp_path: Path) -> None:
    linear = '<ssc:LinearTransformation factor="2" offset="1"/>'
    head = f"<ssd:Connectors>{connector('speed', 'input', 'km/h')}</ssd:Connectors>"
    inner = system(fmu("p"), connection("speed", "p.u", linear), head, "sub")
    outer = inner + fmu("a", unit="m/s") + fmu("s")
    # a.y states no unit; s.x is in m: neither is converted against its will.
    text = structure(
        system(
            outer, connection("a.y", "sub.speed") + connection("s.x", "a.u", suppressUnitConversion="true")
        )
    )
    found = links(package(tmp_path, text))
    assert found["a.y sub_p.u"] == (2 / 3.6, 1.0, False)
    assert found["s.x a.u"] == (1.0, 0.0, False)


def test_units_of_different_dimension_are_an_error(tmp_path: Path) -> None:
    text = structure(system(fmu("a") + fmu("b"), connection("a.x", "b.u")))
    with pytest.raises(ScenarioError, match=r"system\.ssp: unit mismatch: a\.x \[m\] → b\.u \[m/s\]"):
        load(package(tmp_path, text))


def test_nested_systems_are_followed_in_and_out(tmp_path: Path) -> None:
    head = f"<ssd:Connectors>{connector('in', 'input')}{connector('out', 'output')}</ssd:Connectors>"
    deep = system(fmu("p.1"), connection("in", "p.1.u") + connection("p.1.y", "out"), head, "deep")
    deep = deep.replace('startElement="p" startConnector="1.y"', 'startElement="p.1" startConnector="y"')
    middle = system(deep, connection("in", "deep.in") + connection("deep.out", "out"), head, "middle")
    text = structure(
        system(middle + fmu("a") + fmu("b"), connection("a.y", "middle.in") + connection("middle.out", "b.u"))
    )
    assert set(links(package(tmp_path, text))) == {"a.y middle_deep_p_1.u", "middle_deep_p_1.y b.u"}


def test_one_output_may_drive_several(tmp_path: Path) -> None:
    parts = fmu("a") + fmu("b") + fmu("c")
    text = structure(system(parts, connection("a.y", "b.u") + connection("c.u", "a.y")))
    assert load(package(tmp_path, text)).scenario.connections == {"a.y": ["b.u", "c.u"]}


def test_signal_dictionaries_join_what_refers_to_them(tmp_path: Path) -> None:
    def reference(name: str) -> str:
        bus = f"<ssd:Connectors>{connector('speed', 'inout')}</ssd:Connectors>"
        tag = "ssd:SignalDictionaryReference"
        return f'<{tag} name="{name}" dictionary="bus">{bus}</{tag}>'

    entry = '<ssb:DictionaryEntry name="speed"><ssc:Real unit="km/h"/></ssb:DictionaryEntry>'
    units = UNITS.replace("ssd:", "ssb:")
    dictionary = f'<ssb:SignalDictionary {SPACES} version="1.0">{entry}{units}</ssb:SignalDictionary>'
    inside = system(reference("b") + fmu("p"), connection("b.speed", "p.u"), name="sub")
    bus = '<ssd:SignalDictionary name="bus" source="resources/bus.ssb"/>'
    declared = f"<ssd:SignalDictionaries>{bus}</ssd:SignalDictionaries>"
    text = structure(system(inside + reference("r") + fmu("a"), connection("a.y", "r.speed"), tail=declared))
    file = package(tmp_path, text, **{"resources__bus.ssb": dictionary})
    assert links(file) == {"a.y sub_p.u": (1 / 3.6, 0.0, False)}
    inline = declared.replace(' source="resources/bus.ssb"/>', f">{dictionary}</ssd:SignalDictionary>")
    (tmp_path / "inline").mkdir()
    file = package(tmp_path / "inline", text.replace(declared, inline))
    assert links(file) == {"a.y sub_p.u": (1 / 3.6, 0.0, False)}


def test_other_descriptions_and_packages_stand_for_systems(tmp_path: Path) -> None:
    head = f"<ssd:Connectors>{connector('in', 'input')}{connector('out', 'output')}</ssd:Connectors>"
    inner = structure(system(fmu("p"), connection("in", "p.u") + connection("p.y", "out"), head))
    (tmp_path / "inner").mkdir()
    nested = package(tmp_path / "inner", inner, **{"Other.ssd": inner.replace('"p"', '"q"')})

    def part(name: str, kind: str, source: str) -> str:
        bound = parameters({"p.gain": 3.0})
        return (
            f'<ssd:Component name="{name}" type="application/x-ssp-{kind}" source="{source}">{head}{bound}'
            "</ssd:Component>"
        )

    elements = part("one", "definition", "inner.ssd") + part("two", "package", "resources/sub.ssp")
    elements += part("three", "package", "resources/sub.ssp#Other.ssd")
    text = structure(system(elements, connection("one.out", "two.in") + connection("three.out", "one.in")))
    file = package(tmp_path, text, **{"inner.ssd": inner, "resources__sub.ssp": nested.read_bytes()})
    assert set(links(file)) == {"one_p.y two_p.u", "three_q.y one_p.u"}
    assert starts(file) == {"one_p": {"gain": 3.0}, "two_p": {"gain": 3.0}}


# ── parameters ───────────────────────────────────────────────────────────────────────────────────────────


def test_parameters_of_every_type_become_start_values(tmp_path: Path) -> None:
    values = {"gain": 2.5, "n_in": 4, "on": False, "nobody": 1.0}
    assert starts(package(tmp_path, structure(system(fmu("a", parameters(values)))))) == {
        "a": {"gain": 2.5, "n_in": 4, "on": False}
    }


def test_what_is_bound_higher_up_counts_more_and_later_more_than_earlier(tmp_path: Path) -> None:
    inner = system(fmu("p", parameters({"gain": 1.0, "trim": 1.0, "u": 1.0})), name="sub").replace(
        "<ssd:Elements>", parameters({"p.gain": 2.0, "p.trim": 2.0}) + "<ssd:Elements>"
    )
    first, second = parameters({"sub.p.gain": 3.0}), parameters({"gain": 4.0}, prefix="sub.p.")
    both = first.replace("</ssd:ParameterBindings>", "") + second.replace("<ssd:ParameterBindings>", "")
    text = structure(system(inner, head=both))
    assert starts(package(tmp_path, text)) == {"sub_p": {"gain": 4.0, "trim": 2.0, "u": 1.0}}


def test_a_mapping_renames_and_transforms_and_leaves_out_the_rest(tmp_path: Path) -> None:
    entry = '<ssm:MappingEntry source="{}" target="{}">{}</ssm:MappingEntry>'
    linear = '<ssc:LinearTransformation factor="10" offset="1"/>'
    content = f'<ssm:ParameterMapping {SPACES} version="1.0">' + entry.format("k", "gain", linear)
    content += entry.format("k", "trim", "") + "</ssm:ParameterMapping>"
    mapping = f"<ssd:ParameterMapping>{content}</ssd:ParameterMapping>"
    bound = parameters({"k": 0.5, "u": 7.0}, mapping)
    assert starts(package(tmp_path, structure(system(fmu("a", bound))))) == {"a": {"gain": 6.0, "trim": 0.5}}
    (tmp_path / "files").mkdir()
    mapping = '<ssd:ParameterMapping source="resources/map.ssm"/>'
    values = (
        parameters({"k": 0.5, "u": 7.0}).split("<ssd:ParameterValues>")[1].split("</ssd:ParameterValues>")[0]
    )
    values = values.replace("<ssv:ParameterSet", f"<ssv:ParameterSet {SPACES}")
    bound = f'<ssd:ParameterBinding source="resources/set.ssv">{mapping}</ssd:ParameterBinding>'
    bound = f"<ssd:ParameterBindings>{bound}</ssd:ParameterBindings>"
    more = {"resources__map.ssm": content, "resources__set.ssv": values}
    file = package(tmp_path / "files", structure(system(fmu("a", bound))), **more)
    assert starts(file) == {"a": {"gain": 6.0, "trim": 0.5}}


def test_parameters_are_converted_to_the_units_of_the_fmu(tmp_path: Path) -> None:
    text = structure(system(fmu("a", parameters({"u": 36.0}, units="km/h"))))
    assert starts(package(tmp_path, text)) == {"a": {"u": pytest.approx(10.0)}}


def test_a_connector_of_a_system_passes_its_value_on(tmp_path: Path) -> None:
    head = (
        f"<ssd:Connectors>{connector('k', 'parameter')}{connector('speed', 'input', 'km/h')}</ssd:Connectors>"
    )
    inner = fmu("p").replace("<ssd:Connectors>", "<ssd:Connectors>" + connector("gain", "parameter"))
    sub = system(inner, connection("k", "p.gain") + connection("speed", "p.u"), head, "sub")
    text = structure(system(sub, head=parameters({"sub.k": 5.0, "sub.speed": 36.0})))
    assert starts(package(tmp_path, text)) == {"sub_p": {"gain": 5.0, "u": pytest.approx(10.0)}}


# ── what cannot be used ──────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<html/>", "found <html> of version ?, expected <SystemStructureDescription> of SSP 1.0 or 2.0"),
        (structure(system("")).replace('version="1.0"', 'version="3.0"', 1), "of version 3.0, expected"),
        ("<!DOCTYPE x [<!ENTITY a 'b'>]><x/>", "it defines a document type"),
        ("<ssd", "no well-formed XML"),
        (structure(system(fmu("a", source="resources/Prob.fmu"))), "a: no such file 'resources/Prob.fmu'"),
        (structure(system(fmu("a", source="../Probe.fmu"))), "'../Probe.fmu' is no file beside the descr"),
        (structure(system(fmu("a", source="file:///etc/passwd"))), "is no file beside the description"),
        (structure(system(fmu("a", source="http://x/y.fmu"))), "is no file beside the description"),
        (structure(system(fmu("a").replace("x-fmu-shared", "x-other"))), "components of type"),
        (structure(system(fmu("a"), connection("a.y", "b.u"))), "there is no element 'b'"),
        (structure(system(fmu("a") + fmu("b"), connection("a.y", "b.x"))), "both of its ends give values"),
        (structure(system(fmu("a") + fmu("b"), connection("a.u", "b.u"))), "both of its ends take values"),
        (
            structure(
                system(fmu("a") + fmu("b"), connection("a.y", "b.u", "<ssc:BooleanMappingTransformation/>"))
            ),
            "<BooleanMappingTransformation> is not supported",
        ),
        (
            structure(system(fmu("a", parameters({"gain": 1.0}).replace('value="1.0"', 'value="one"')))),
            "parameters of a: 'one' is no value of type Real",
        ),
        (structure(system(fmu("a") + fmu("b"), connection("a.y", "b.z"))), "b has no variable 'z'"),
        (
            structure(
                system(
                    fmu("a") + fmu("b"),
                    connection("a.y", "b.u") + connection("a.x", "b.u", suppressUnitConversion="true"),
                )
            ),
            "b.u is driven twice",
        ),
    ],
)
def test_a_package_that_cannot_be_used_says_why(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ScenarioError) as error:
        load(package(tmp_path, text))
    assert message in str(error.value)
    assert str(error.value).startswith(str(tmp_path / "system.ssp"))


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('stopTime="2"', 'stopTime="soon"'),
        ('m="1" s="-1"/>', 'm="1.5" s="-1"/>'),
        ('factor="0.27', 'factor="x0.27'),
    ],
)
def test_attributes_that_are_no_numbers_are_told(tmp_path: Path, old: str, new: str) -> None:
    with pytest.raises(ScenarioError, match="an attribute is no number: "):
        load(package(tmp_path, structure(system(fmu("a"))).replace(old, new, 1)))


def test_a_description_within_itself_is_told(tmp_path: Path) -> None:
    own = '<ssd:Component name="a" type="application/x-ssp-definition" source="SystemStructure.ssd"/>'
    with pytest.raises(ScenarioError, match="systems are nested too deeply, or in each other"):
        load(package(tmp_path, structure(system(own))))


def test_connectors_in_a_circle_end(tmp_path: Path) -> None:
    head = f"<ssd:Connectors>{connector('one', 'inout')}{connector('two', 'inout')}</ssd:Connectors>"
    circle = connection("one", "two") + connection("two", "one") + connection("two", "p.u")
    sub = system(fmu("p"), circle, head, "sub")
    text = structure(system(sub + fmu("a"), connection("a.y", "sub.one")))
    assert set(links(package(tmp_path, text))) == {"a.y sub_p.u"}


@given(seed=st.integers(0, 2**32))
@settings(max_examples=100, deadline=None)
def test_a_damaged_description_is_told_or_read(seed: int, tmp_path_factory: pytest.TempPathFactory) -> None:
    random = Random(seed)
    head = f"<ssd:Connectors>{connector('in', 'input')}</ssd:Connectors>"
    sub = system(fmu("p", parameters({"gain": 1.0})), connection("in", "p.u"), head, "sub")
    text = list(structure(system(sub + fmu("a"), connection("a.y", "sub.in"))))
    for _ in range(random.choice([1, 2, 5])):
        at, size = random.randrange(len(text)), random.choice([1, 4, 20])
        if random.random() < 0.5:
            del text[at : at + size]
        else:
            text[at] = random.choice('<>"=/a0-.9&;')
    folder = tmp_path_factory.mktemp("damaged")
    (folder / "resources").mkdir()
    probe(folder / "resources")
    (folder / "x.ssd").write_text("".join(text))
    with contextlib.suppress(ScenarioError):
        load(folder / "x.ssd")


def test_all_problems_are_told_at_once(tmp_path: Path) -> None:
    text = structure(system(fmu("a", source="x.fmu") + fmu("b", source="y.fmu"), connection("c.y", "b.u")))
    with pytest.raises(ScenarioError) as error:
        load(package(tmp_path, text))
    assert len(error.value.problems) == 3


def test_files_that_are_no_packages_are_told(tmp_path: Path) -> None:
    (tmp_path / "x.ssp").write_text("no zip")
    with pytest.raises(ScenarioError, match="not a zip archive, as every SSP is"):
        load(tmp_path / "x.ssp")
    with pytest.raises(ScenarioError, match=r"no such file 'y\.ssp'"):
        load(tmp_path / "y.ssp")
    with pytest.raises(ScenarioError, match=r"no SystemStructure\.ssd"):
        load(pack(tmp_path / "z.ssp", {"a": "b"}))
    with pytest.raises(ScenarioError, match="outside its folder"):
        load(pack(tmp_path / "w.ssp", {"../a": "b"}))


def test_python_in_a_package_is_not_run(tmp_path: Path) -> None:
    own = (
        '<ssd:Component name="p" type="application/x-exlinn-component"><ssd:Annotations><ssc:Annotation '
        'type="com.github.exlinn">{"python": "evil:Evil"}</ssc:Annotation></ssd:Annotations></ssd:Component>'
    )
    file = package(tmp_path, structure(system(own)), **{"evil.py": "raise SystemExit('harm')"})
    with pytest.raises(ScenarioError, match="p: the package brings Python code, which is not run"):
        load(file)


# ── writing ──────────────────────────────────────────────────────────────────────────────────────────────

SCENARIO = """\
name: pair
description: two probes
seed: 3
components:
  src: {source: {signal: sine, amplitude: 1, frequency: 0.5, unit: km/h}}
  a: {fmu: Probe.fmu, start: {gain: 0.5, n_in: 3, on: false}}
  b: {fmu: Probe.fmu, isolate: false, step: 0.2}
connections:
  src.y: a.u
  a.x: {to: b.u, factor: 2, offset: -1, convert: false}
  a.n_out: b.n_in
events:
  - {on: a.u, at: 1, add: 0.5}
simulate: {stop: 2, step: 0.1, algorithm: gauss-seidel}
"""


def results(file: Path, out: Path) -> bytes:
    assert cli.exit_code(["simulate", str(file), "--out", str(out)]) == 0
    return (out / "trajectories.csv").read_bytes()


@pytest.mark.parametrize("version", ["1.0", "2.0"])
def test_a_scenario_that_is_written_and_read_gives_the_same_results(tmp_path: Path, version: str) -> None:
    probe(tmp_path)
    (tmp_path / "pair.yaml").write_text(SCENARIO)
    file = tmp_path / "out" / "pair.ssp"
    file.parent.mkdir()
    command = ["export", "ssp", str(tmp_path / "pair.yaml"), "--out", str(file), "--ssp", version]
    assert cli.exit_code(command) == 0
    first = file.read_bytes()
    assert cli.exit_code(command) == 0
    assert file.read_bytes() == first
    with zipfile.ZipFile(file) as archive:
        assert sorted(archive.namelist()) == ["SystemStructure.ssd", "resources/Probe.fmu"]
        assert f'version="{version}"' in archive.read("SystemStructure.ssd").decode()
    assert results(file, tmp_path / "ssp") == results(tmp_path / "pair.yaml", tmp_path / "yaml")
    again = tmp_path / "out" / "again.ssp"
    assert cli.exit_code(["export", "ssp", str(file), "--out", str(again), "--ssp", version]) == 0
    assert links(again) == links(file)


def test_what_cannot_be_packed_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    probe(tmp_path)
    table = "{source: {signal: table, file: ../t.csv, column: y, unit: km/h}}"
    (tmp_path / "t.csv").write_text("time,y\n0,1\n1,2\n")
    (tmp_path / "below").mkdir()
    text = SCENARIO.replace("{source: {signal: sine, amplitude: 1, frequency: 0.5, unit: km/h}}", table)
    (tmp_path / "below" / "s.yaml").write_text(text.replace("Probe.fmu", "../Probe.fmu"))
    out = str(tmp_path / "s.ssp")
    assert cli.exit_code(["export", "ssp", str(tmp_path / "below" / "s.yaml"), "--out", out]) == 1
    assert "'../t.csv' is not below the scenario's folder" in capsys.readouterr().err
    assert cli.exit_code(["export", "ssp", str(tmp_path / "below" / "s.yaml"), "--ssp", "3"]) == 1
    assert "expected 1.0 or 2.0" in capsys.readouterr().err


def test_files_that_components_name_go_along(tmp_path: Path) -> None:
    probe(tmp_path)
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "t.csv").write_text("time,y\n0,1\n1,2\n")
    (tmp_path / "gain.py").write_text(
        "from exlinn_fmi import PythonComponent, Variable\nclass Gain(PythonComponent):\n"
        "    variables = (Variable('u', 'input'), Variable('y', 'output', depends_on=('u',)))\n"
        "    def outputs(self, t):\n        self['y'] = 2 * self['u']\n"
    )
    table = "{source: {signal: table, file: data/t.csv, column: y, unit: km/h}}\n  g: {python: gain:Gain}"
    text = SCENARIO.replace("{source: {signal: sine, amplitude: 1, frequency: 0.5, unit: km/h}}", table)
    (tmp_path / "s.yaml").write_text(text.replace("a.u\n", "[a.u, g.u]\n"))
    file = tmp_path / "s.ssp"
    assert cli.exit_code(["export", "ssp", str(tmp_path / "s.yaml"), "--out", str(file)]) == 0
    with pytest.raises(ScenarioError, match="brings Python code"):
        load(file)
    with zipfile.ZipFile(file) as archive:
        archive.extractall(tmp_path / "unpacked")
    unpacked = tmp_path / "unpacked" / "SystemStructure.ssd"
    assert results(unpacked, tmp_path / "a") == results(tmp_path / "s.yaml", tmp_path / "b")


def test_two_fmus_of_one_name_are_told_apart(tmp_path: Path) -> None:
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        text = description_2().replace("Probe maker", name)
        probe(tmp_path / name, description=text)
    (tmp_path / "s.yaml").write_text(
        "name: s\ncomponents:\n  a: {fmu: one/Probe.fmu}\n  b: {fmu: two/Probe.fmu}\nsimulate: {stop: 1}\n"
    )
    assert cli.exit_code(["export", "ssp", str(tmp_path / "s.yaml"), "--out", str(tmp_path / "s.ssp")]) == 0
    with zipfile.ZipFile(tmp_path / "s.ssp") as archive:
        assert "resources/Probe_2.fmu" in archive.namelist()
    loaded = load(tmp_path / "s.ssp")
    assert loaded.scenario.components["a"].fmu != loaded.scenario.components["b"].fmu
