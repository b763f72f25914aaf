"""Scenario text: YAML 1.2 and nothing of YAML 1.1, lines of key paths, mistakes in the text."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ruamel.yaml import YAML

from exlinn_fmi.scenario import document
from exlinn_fmi.scenario.document import parse


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-3", 1e-3),
        ("1E5", 1e5),
        (".5", 0.5),
        ("-.5e3", -500.0),
        ("5.", 5.0),
        ("+1", 1),
        ("010", 10),
        ("0o17", 15),
        ("0x1F", 31),
        ("-.inf", -math.inf),
        ("true", True),
        ("False", False),
        ("~", None),
        ("", None),
        ("!!float 1", 1.0),
        ("!!str 5", "5"),
    ],
)
def test_plain_scalars_follow_the_core_schema(text, value):
    data = parse(f"a: {text}").data
    assert data == {"a": value}
    assert type(data["a"]) is type(value)


@pytest.mark.parametrize(
    "text", ["on", "off", "yes", "No", "1_000", "12:30", "2001-01-01", "tRue", "=", "0b11"]
)
def test_what_only_yaml_1_1_converts_stays_text(text):
    assert parse(f"a: {text}").data == {"a": text}


@pytest.mark.parametrize("text", ["'1'", '"true"', "'null'", "|-\n  5"])
def test_quoted_scalars_are_text(text):
    assert isinstance(parse(f"a: {text}").data["a"], str)


def test_nan_is_a_number():
    assert math.isnan(parse("a: .nan").data["a"])


@settings(deadline=None, max_examples=50)
@given(st.floats(allow_nan=False))
def test_numbers_as_python_writes_them_read_back(value):
    text = repr(value).replace("inf", ".inf")
    assert parse(f"a: {text}").data == {"a": value}


def test_keys_are_names_whatever_they_look_like():
    assert parse("1: a\non: b\nnull: c\n").data == {"1": "a", "on": "b", "null": "c"}


def test_every_key_and_list_item_has_its_line():
    lines = parse("a: 1\nb:\n  - 2\n  - c: 3\n    d: [4,\n        5]\n").lines
    assert lines[("b", 1, "d", 1)] == 6
    assert lines[("b", 1, "c")] == 4
    assert lines[("b",)] == 2


def test_the_line_of_what_is_not_there_is_that_of_what_is_around_it():
    assert parse("a:\n  b: 1\n").line(("a", "x", "y")) == 1


def test_an_alias_stands_for_a_copy():
    data = parse("a: &x {b: [1]}\nc: *x\n").data
    assert data == {"a": {"b": [1]}, "c": {"b": [1]}}
    assert data["a"]["b"] is not data["c"]["b"]


def test_a_byte_order_mark_and_a_document_start_are_no_content():
    assert parse("\ufeff%YAML 1.2\n---\na: 1\n").data == {"a": 1}


@pytest.mark.parametrize(
    ("text", "line", "message"),
    [
        ("a: 1\nb: 2\na: 3", 3, "key 'a' is given twice, first on line 1"),
        ("a:\n  b: [1\nc: 2", 3, "begins on line 2 (column 2)"),
        ("a:\n\tb: 1", 2, "indent with spaces, not tabs"),
        ("a: b: c", 1, "not YAML: mapping values are not allowed here (column 5); put text that holds ': '"),
        ("a: 'b\n", 2, "while scanning a quoted scalar that begins on line 1"),
        ("a: *b", 1, "undefined alias"),
        ("a: 1\n---\nb: 2", 2, "a scenario is one document"),
        ("a: 1\nb: \x01", 2, "special characters are not allowed"),
        ("a: {<<: 1}", 1, "merge keys (<<) are not part of YAML 1.2"),
        ("a: 1\n? [b]\n: 2", 2, "a key must be a name"),
        ("a: !!python/object:os.system x", 1, "has no meaning here"),
        ("a: !!omap [b: 1]", 1, "has no meaning here"),
        ("a: !!int x", 1, "has no meaning here"),
        ("a: &x [*x]", 1, "an alias stands within what it is an alias of"),
        ("a: " + "9" * 5000, 1, "too many digits"),
        ("[" * 500, 0, "nested too deeply"),
    ],
)
def test_a_mistake_in_the_text_is_named_with_its_line(text, line, message):
    (problem,) = parse(text).problems
    assert message in problem.message
    assert problem.line == line


def test_all_keys_given_twice_are_reported():
    problems = parse("a: 1\na: 2\nb: {c: 1, c: 2}\n").problems
    assert [(p.path, p.line) for p in problems] == [("a", 2), ("b.c", 3)]


def test_aliases_of_aliases_do_not_fill_the_memory(monkeypatch):
    monkeypatch.setattr(document, "MOST_VALUES", 1000)
    text = "a0: &a0 [1, 1]\n" + "".join(f"a{k}: &a{k} [{f'*a{k - 1}, ' * 9}]\n" for k in range(1, 9))
    (problem,) = parse(text).problems
    assert problem.message.startswith("more than 1000 values")


@given(
    st.text(st.characters(codec="utf-8"), max_size=60) | st.text("ab:-[]{}\"'&*!#|>?, \n\t0.", max_size=60)
)
def test_any_text_gives_data_or_problems(text):
    result = parse(text)
    assert result.problems or YAML(typ="safe", pure=True).compose(text) is None or result.lines
