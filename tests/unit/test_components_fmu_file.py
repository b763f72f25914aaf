"""FMU files that cannot be used: what the error says, and that nothing of them gets onto the disk."""

from __future__ import annotations

import contextlib
import errno
import platform
import stat
import subprocess
import warnings
import zipfile
from pathlib import Path
from random import Random

import fmpy
import pytest
from fmu_helpers import VARIABLES_2, description_2, description_3, library, pack, probe
from hypothesis import example, given, settings
from hypothesis import strategies as st

from exlinn_fmi.components import archive
from exlinn_fmi.components.fmu import FmuComponent, read_variables
from exlinn_fmi.components.fmu_file import read_description, unpack
from exlinn_fmi.errors import FmuError, StorageError

BINARY = f"binaries/{fmpy.platform}/Probe{fmpy.sharedLibraryExtension}"


def with_description(folder: Path, text: str) -> Path:
    return pack(folder / "Probe.fmu", {"modelDescription.xml": text})


# ── not an FMU ───────────────────────────────────────────────────────────────────────────────────────────


def test_a_missing_file_is_told_with_the_nearest_name(tmp_path: Path) -> None:
    probe(tmp_path)
    with pytest.raises(FmuError, match=r"Prob\.fmu: no such file; did you mean 'Probe\.fmu'\?"):
        read_variables(tmp_path / "Prob.fmu")


def test_a_missing_folder_is_told(tmp_path: Path) -> None:
    with pytest.raises(FmuError, match="no such file; there are no FMUs there"):
        read_variables(tmp_path / "nowhere" / "Probe.fmu")


def test_a_folder_is_told(tmp_path: Path) -> None:
    with pytest.raises(FmuError, match=r"is a folder, expected an \.fmu file"):
        read_variables(tmp_path)


def test_a_file_that_is_no_archive_is_told(tmp_path: Path) -> None:
    (tmp_path / "Probe.fmu").write_text("<html>404</html>")
    with pytest.raises(FmuError, match="not a zip archive, as every FMU is"):
        read_variables(tmp_path / "Probe.fmu")


@pytest.mark.parametrize("kept", [0.2, 0.9, 0.999])
def test_a_truncated_archive_is_told(tmp_path: Path, kept: float) -> None:
    path = probe(tmp_path)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * kept)])
    with pytest.raises(FmuError, match=r"the zip archive is damaged or cut short \(\d+ bytes"):
        FmuComponent("probe", path)


def test_a_damaged_binary_in_the_archive_is_told(tmp_path: Path) -> None:
    path = probe(tmp_path)
    with zipfile.ZipFile(path) as archive:
        info = archive.getinfo(BINARY)
    data = bytearray(path.read_bytes())
    middle = info.header_offset + 200
    data[middle : middle + 40] = bytes(40)
    path.write_bytes(data)
    with pytest.raises(FmuError, match="damaged or cut short"):
        FmuComponent("probe", path)


def test_a_file_that_may_not_be_read_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = probe(tmp_path)

    def refuse(_: Path) -> None:  # root, as in containers, may read every file
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(zipfile, "ZipFile", refuse)
    with pytest.raises(FmuError, match="cannot be read: Permission denied"):
        read_variables(path)


def test_an_archive_without_model_description_is_told(tmp_path: Path) -> None:
    path = pack(tmp_path / "Probe.fmu", {"readme.txt": "hello"})
    with pytest.raises(FmuError, match=r"no modelDescription\.xml at the top of the archive; no FMU"):
        read_variables(path)


def test_a_zipped_folder_is_told(tmp_path: Path) -> None:
    path = pack(tmp_path / "Probe.fmu", {"Probe/modelDescription.xml": description_2()})
    with pytest.raises(FmuError, match="zip the folder's contents, not the folder"):
        read_variables(path)


# ── a model description that cannot be used ──────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<fmiModelDescription fmiVersion='2.0'", "no well-formed XML: .*line 1"),
        ("<?xml version='1.0' encoding='UTF-9'?><a/>", "no well-formed XML: .*UTF-9"),
        ("<html/>", "begins with <html>, expected <fmiModelDescription>"),
        (description_2(version="4.0"), r"FMI version 4\.0; expected 1\.0, 2\.0 or 3\.0"),
        (
            description_3().replace("CoSimulation", "ScheduledExecution"),
            r"no Co-Simulation and no Model Exchange of FMI 2\.0 or 3\.0: it is for Scheduled Execution only",
        ),
        (description_2(identifier="../../Probe"), "the model identifier '../../Probe' is no C identifier"),
        (description_2(identifier=""), "the model identifier '' is no C identifier"),
        (description_2(variables=VARIABLES_2 * 2), "two variables are called 'u'"),
        (
            description_2(variables=VARIABLES_2.replace('start="2" min', 'start="two" min')),
            r"variable 'gain' \(line \d+\): could not convert string to float: 'two'",
        ),
        (
            description_2(
                variables=VARIABLES_2.replace('declaredType="Mode" start', 'declaredType="X" start')
            ),
            r"does not follow FMI 2\.0: .*declaredType",
        ),
        (
            description_2(variables=VARIABLES_2.replace('valueReference="1" ', "", 1)),
            r"does not follow FMI 2\.0: .*valueReference",
        ),
    ],
)
def test_a_model_description_that_cannot_be_used_is_told(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(FmuError, match=message):
        read_variables(with_description(tmp_path, text))


def test_a_problem_that_no_schema_knows_is_told_in_fmpys_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object, **options: bool) -> None:
        if not options["validate"]:
            raise KeyError("odd")

    monkeypatch.setattr(fmpy, "read_model_description", broken)
    with pytest.raises(FmuError, match=r"does not follow FMI 2\.0: KeyError: 'odd'"):
        read_variables(with_description(tmp_path, description_2()))


def test_a_huge_model_description_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(archive, "LARGEST_XML", 1000)
    with pytest.raises(FmuError, match="expected at most"):
        read_variables(with_description(tmp_path, description_2()))


# ── an archive that means harm ───────────────────────────────────────────────────────────────────────────


def test_backslashes_of_old_tools_are_named_as_such(tmp_path: Path) -> None:
    path = pack(
        tmp_path / "Probe.fmu", {"modelDescription.xml": description_2(), "binaries\\win32\\a.dll": ""}
    )
    with pytest.raises(FmuError, match="names in archives take '/'"):
        FmuComponent("probe", path)


@pytest.mark.parametrize("name", ["../evil.txt", "/etc/evil.txt", "a/../../evil.txt", "..\\evil", "C:/evil"])
def test_members_outside_the_folder_are_refused(tmp_path: Path, name: str) -> None:
    path = pack(tmp_path / "Probe.fmu", {"modelDescription.xml": description_2(), name: "evil"})
    with pytest.raises(FmuError, match="would be written outside its folder"):
        FmuComponent("probe", path)


def test_a_member_that_is_there_twice_is_refused(tmp_path: Path) -> None:
    path = probe(tmp_path)
    with warnings.catch_warnings(), zipfile.ZipFile(path, "a") as archive:
        warnings.simplefilter("ignore")
        archive.writestr("modelDescription.xml", description_2())
    with pytest.raises(FmuError, match=r"holds 'modelDescription\.xml' twice"):
        read_variables(path)


def test_an_archive_that_does_not_fit_is_not_unpacked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("EXLINN_CACHE", str(tmp_path / "cache"))
    path = probe(tmp_path)
    usage = type("Usage", (), {"free": 10})
    monkeypatch.setattr(archive.shutil, "disk_usage", lambda _: usage)
    with pytest.raises(StorageError, match="MB free"):
        FmuComponent("probe", path)
    assert not list((tmp_path / "cache").iterdir())


def test_a_zip_bomb_is_not_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(archive, "LARGEST_HARMLESS", 2**20)
    members = {
        "modelDescription.xml": description_2(),
        BINARY: library("probe2.c"),
        "resources/x": bytes(2**24),
    }
    with pytest.raises(FmuError, match=r"MB that unpack to 17 MB: this is a zip bomb"):
        FmuComponent("probe", pack(tmp_path / "Probe.fmu", members))


def test_a_disk_that_fills_while_unpacking_is_told(
    tmp_path: Path, tiny_disk: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("EXLINN_CACHE", str(tiny_disk))
    monkeypatch.setattr(archive.shutil, "disk_usage", lambda _: type("Usage", (), {"free": 1e12}))
    members = {
        "modelDescription.xml": description_2(),
        BINARY: library("probe2.c"),
        "resources/x": bytes(10**6),
    }
    path = pack(tmp_path / "Probe.fmu", members)
    with pytest.raises(StorageError, match=r"Probe\.fmu: cannot be unpacked: .*No space left"):
        FmuComponent("probe", path)
    assert not list(tiny_disk.iterdir())


# ── binaries ─────────────────────────────────────────────────────────────────────────────────────────────


def test_a_missing_binary_is_told_with_those_there_are_and_what_to_do(tmp_path: Path) -> None:
    members = {
        "modelDescription.xml": description_2(),
        "binaries/win64/Probe.dll": "MZ",
        "binaries/win32/Probe.dll": "MZ",
        "sources/Probe.c": "int x;",
    }
    path = pack(tmp_path / "Probe.fmu", members)
    assert read_variables(path)
    with pytest.raises(FmuError, match="no binary"):
        read_variables(path, runnable=True)
    with pytest.raises(FmuError) as error:
        FmuComponent("probe", path)
    assert str(error.value) == (
        f"{path}: no binary for {fmpy.platform} in it (found: win32, win64); "
        f"export it again for {fmpy.platform}, or build the sources in it: fmpy compile Probe.fmu"
    )


def test_an_fmu_without_any_binary_is_told(tmp_path: Path) -> None:
    with pytest.raises(FmuError, match=r"\(found: none\); export it again for \w+$"):
        FmuComponent("probe", with_description(tmp_path, description_2()))


def test_a_binary_of_another_name_is_told(tmp_path: Path) -> None:
    members = {"modelDescription.xml": description_2(), f"binaries/{fmpy.platform}/Other.so": "x"}
    path = pack(tmp_path / "Probe.fmu", members)
    with pytest.raises(FmuError, match=rf"has no Probe\{fmpy.sharedLibraryExtension} \(found: Other\.so\)"):
        FmuComponent("probe", path)


FOREIGN = bytes.fromhex("7f454c46020101000000000000000000") + bytes.fromhex("0300b700") + bytes(200)
"""The head of a shared library for AArch64."""


@pytest.mark.parametrize("binary", [b"", b"not a library", FOREIGN])
def test_a_binary_that_cannot_be_loaded_is_told(tmp_path: Path, binary: bytes) -> None:
    path = pack(tmp_path / "Probe.fmu", {"modelDescription.xml": description_2(), BINARY: binary})
    before = Path.cwd()
    with pytest.raises(FmuError) as error:
        FmuComponent("probe", path)
    assert f"the binary for {fmpy.platform} cannot be loaded: {BINARY}: " in str(error.value)
    assert "damaged, made for another machine, or need libraries" in str(error.value)
    assert Path.cwd() == before


@pytest.mark.parametrize("kept", [100, 2000, 9000])
def test_a_binary_that_is_cut_short_is_told_before_the_loader_crashes_on_it(
    tmp_path: Path, kept: int
) -> None:
    members = {"modelDescription.xml": description_2(), BINARY: library("probe2.c")[:kept]}
    with pytest.raises(FmuError, match=rf"is cut short at {kept} bytes"):
        FmuComponent("probe", pack(tmp_path / "Probe.fmu", members))


def test_only_what_this_machine_needs_is_unpacked(tmp_path: Path) -> None:
    members = {
        "modelDescription.xml": description_2(),
        BINARY: library("probe2.c"),
        "binaries/win64/Probe.dll": "MZ",
        "sources/Probe.c": "int x;",
        "documentation/index.html": "<html/>",
        "resources/table.txt": "1 2 3",
    }
    lease = unpack(read_description(pack(tmp_path / "Probe.fmu", members)))
    files = {str(p.relative_to(lease.folder)) for p in lease.folder.rglob("*") if p.is_file()}
    assert files == {"modelDescription.xml", BINARY, "resources/table.txt"}
    assert stat.S_IMODE(lease.folder.stat().st_mode) == 0o700
    lease.release()


def test_the_platform_is_named_as_the_fmi_version_has_it(tmp_path: Path) -> None:
    assert read_description(probe(tmp_path)).platform == fmpy.platform
    three = read_description(probe(tmp_path, version=3)).platform
    assert three.startswith(platform.machine().lower().replace("amd64", "x86_64"))


# ── more that means harm ─────────────────────────────────────────────────────────────────────────────────


BOMB = '<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]>'
READER = '<!DOCTYPE x [<!ENTITY a SYSTEM "file:///etc/passwd">]>'


@pytest.mark.parametrize("doctype", [BOMB, READER, "<!DOCTYPE fmiModelDescription SYSTEM 'http://x/y.dtd'>"])
@pytest.mark.parametrize("encoding", ["UTF-8", "UTF-16"])
def test_a_document_type_is_refused_before_an_entity_can_grow(
    tmp_path: Path, doctype: str, encoding: str
) -> None:
    text = description_2().replace("?>", f"?>{doctype}", 1).replace("UTF-8", encoding)
    path = pack(tmp_path / "Probe.fmu", {"modelDescription.xml": text.encode(encoding)})
    with pytest.raises(FmuError, match="defines a document type"):
        read_variables(path)


def test_elements_nested_a_million_deep_are_told(tmp_path: Path) -> None:
    deep = "<a>" * 10**6 + "</a>" * 10**6
    text = description_2().replace("<ModelVariables>", f"<ModelVariables>{deep}")
    with pytest.raises(FmuError, match=r"modelDescription\.xml"):
        read_variables(with_description(tmp_path, text))


@pytest.mark.parametrize("mode", [stat.S_IFLNK, stat.S_IFIFO, stat.S_IFCHR])
def test_links_and_devices_are_refused(tmp_path: Path, mode: int) -> None:
    path = probe(tmp_path)
    info = zipfile.ZipInfo("resources/table.txt")
    info.external_attr = (mode | 0o777) << 16
    with zipfile.ZipFile(path, "a") as file:
        file.writestr(info, "/etc/passwd")
    with pytest.raises(FmuError, match=r"'resources/table\.txt' in it is (a link|no file); put the file"):
        FmuComponent("probe", path)


@pytest.mark.parametrize("name", ["resources/a\x00b", "resources/a\nb", "resources/\x1b[2J"])
def test_names_that_are_no_file_names_are_refused(tmp_path: Path, name: str) -> None:
    path = probe(tmp_path)
    stand_in = "resources/" + "z" * (len(name) - 10)
    with zipfile.ZipFile(path, "a") as file:
        file.writestr(stand_in, "x")
    path.write_bytes(path.read_bytes().replace(stand_in.encode(), name.encode()))
    if "\x00" in name:  # which zipfile takes for the end of the name
        assert read_variables(path)
        return
    with pytest.raises(FmuError, match="which is no file name"):
        read_variables(path)


@pytest.mark.parametrize(
    ("first", "second", "word"),
    [
        ("resources/a", "resources/./a", "twice"),
        ("resources/a", "resources//a", "twice"),
        ("resources/a/b", "resources/a", "twice"),
        ("resources/a", "resources/a/b", "as a file and as a folder"),
    ],
)
def test_members_that_would_land_on_one_another_are_refused(
    tmp_path: Path, first: str, second: str, word: str
) -> None:
    path = probe(tmp_path)
    with zipfile.ZipFile(path, "a") as file:
        file.writestr(first, "x")
        file.writestr(second, "y")
    with pytest.raises(FmuError, match=word):
        read_variables(path)


def test_an_archive_of_very_many_members_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(archive, "MOST_MEMBERS", 100)
    members = dict.fromkeys((f"resources/{k}" for k in range(100)), "")
    path = pack(tmp_path / "Probe.fmu", {"modelDescription.xml": description_2(), **members})
    with pytest.raises(FmuError, match="has 101 members, expected at most 100"):
        read_variables(path)


def test_a_member_that_is_larger_than_it_says_is_not_unpacked(tmp_path: Path) -> None:
    path = probe(tmp_path)
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as file:
        file.writestr("resources/x", bytes(10**6))
    said = (10**6).to_bytes(4, "little")
    path.write_bytes(path.read_bytes().replace(said, (10).to_bytes(4, "little")))
    with pytest.raises(FmuError, match="damaged or cut short"):
        FmuComponent("probe", path)


@pytest.mark.parametrize("identifier", ["a/b", "..", "a b", "Probe\n", "a" * 201, "Prøbe", "1st"])
def test_a_model_identifier_that_is_no_c_identifier_is_refused(tmp_path: Path, identifier: str) -> None:
    with pytest.raises(FmuError, match="is no C identifier"):
        read_variables(
            with_description(tmp_path, description_2(identifier=identifier.replace("\n", "&#10;")))
        )


def test_an_fmu_for_windows_starts_no_other_program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("a program was started")

    monkeypatch.setattr(subprocess, "Popen", refuse)
    members = {"modelDescription.xml": description_2(), "binaries/win64/Probe.dll": "MZ"}
    with pytest.raises(FmuError, match="no binary for"):
        FmuComponent("probe", pack(tmp_path / "Probe.fmu", members))


def test_a_description_of_many_variables_is_read_and_a_mistake_at_its_end_told(tmp_path: Path) -> None:
    one = '<ScalarVariable name="v{0}" valueReference="{0}"><Real/></ScalarVariable>'
    many = "".join(one.format(k) for k in range(20_000))
    assert len(read_variables(with_description(tmp_path, description_2(variables=many)))) == 20_000
    twice = many + one.format(19_999)
    with pytest.raises(FmuError, match="two variables are called 'v19999'"):
        read_variables(with_description(tmp_path, description_2(variables=twice)))
    wrong = many + '<ScalarVariable name="w"><Real/></ScalarVariable>'
    with pytest.raises(
        FmuError, match=r"does not follow FMI 2\.0: TypeError"
    ):  # validation would take minutes
        read_variables(with_description(tmp_path, description_2(variables=wrong)))


# ── anything at all ──────────────────────────────────────────────────────────────────────────────────────


@given(seed=st.integers(0, 2**32), flips=st.sampled_from([1, 3, 30, 300]), last=st.sampled_from([400, 10**6]))
@example(seed=73806, flips=300, last=10**6)  # a name that is no UTF-8
@settings(max_examples=200, deadline=None)
def test_a_damaged_archive_is_told_or_whole(
    seed: int, flips: int, last: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("damaged")
    path = probe(folder)
    data, random = bytearray(path.read_bytes()), Random(seed)
    for _ in range(flips):
        data[random.randrange(max(0, len(data) - last), len(data))] = random.randrange(256)
    path.write_bytes(data)
    with contextlib.suppress(FmuError, StorageError):
        unpack(read_description(path)).release()


@given(seed=st.integers(0, 2**32), version=st.sampled_from([2, 3]))
@settings(max_examples=150, deadline=None)
def test_a_damaged_description_is_told_or_read(
    seed: int, version: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    random, text = Random(seed), list(description_2() if version == 2 else description_3())
    for _ in range(random.choice([1, 2, 5])):
        at, size = random.randrange(len(text)), random.choice([1, 4, 20])
        act = random.randrange(3)
        if act == 0:
            del text[at : at + size]
        elif act == 1:
            start = random.randrange(len(text))
            text[at:at] = text[start : start + size]
        else:
            text[at] = random.choice('<>"=/a0-.9&;')
    with contextlib.suppress(FmuError):
        read_variables(with_description(tmp_path_factory.mktemp("damaged"), "".join(text)))
