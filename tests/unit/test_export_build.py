"""Compiling and packing: reproducible, and clear about what is missing."""

from __future__ import annotations

import stat
import zipfile
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from export_helpers import instance

from exlinn_fmi import export
from exlinn_fmi.errors import FmuError, InputError, RunError, StorageError
from exlinn_fmi.export import export_plant, export_system, platforms
from exlinn_fmi.export.build import Options
from exlinn_fmi.export.check import check_fmu
from exlinn_fmi.mechanics.coordinates import Coordinate
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem
from exlinn_fmi.mechanics.learned import ModelSpec, Scales, learned_system
from exlinn_fmi.plants import plant

PLANT = plant("dc_motor_cart")
PENDULUM = LagrangianSystem.build(
    (Coordinate("theta", "rad", topology="circle"),),
    lambda q, v, p: v[0] ** 2 / 2 + 9.81 * ca.cos(q[0]),
    lambda v, p: 0 * v[0],
)


def test_public_names_are_sorted_and_exist() -> None:
    assert export.__all__ == sorted(export.__all__)
    assert all(hasattr(export, name) for name in export.__all__)


def test_the_same_plant_gives_the_same_bytes(tmp_path: Path) -> None:
    first, second = (export_plant(PLANT, tmp_path / name) for name in ("a.fmu", "b.fmu"))
    assert first.read_bytes() == second.read_bytes()


def test_a_folder_gets_the_file_under_the_models_name(tmp_path: Path) -> None:
    assert export_system(PENDULUM, tmp_path, name="Pendulum") == tmp_path / "Pendulum.fmu"


def test_no_member_depends_on_time_or_order(tmp_path: Path) -> None:
    with zipfile.ZipFile(export_system(PENDULUM, tmp_path, name="Pendulum")) as archive:
        infos = archive.infolist()
    assert {i.date_time for i in infos} == {(1980, 1, 1, 0, 0, 0)}
    assert [i.filename for i in infos] == sorted(i.filename for i in infos)


def test_the_binary_names_no_folder_of_the_machine_that_built_it(tmp_path: Path) -> None:
    with zipfile.ZipFile(export_system(PENDULUM, tmp_path, name="Pendulum")) as archive:
        (binary,) = (archive.read(n) for n in archive.namelist() if n.startswith("binaries/"))
    assert b"exlinn-export-" not in binary
    assert str(Path.home()).encode() + b"/" not in binary


def test_a_system_without_inputs_and_parameters_runs_and_keeps_its_energy(tmp_path: Path) -> None:
    with instance(export_system(PENDULUM, tmp_path, name="Pendulum", start={"theta": 2.0})) as made:
        made.start()
        (before,) = made.get("energy")
        for k in range(100):
            made.fmu.doStep(k * 0.01, 0.01)
        assert made.get("energy")[0] == pytest.approx(before, abs=1e-9)
        assert made.get("theta")[0] != 2.0


def test_a_learned_model_runs_as_in_python(tmp_path: Path) -> None:
    scales = Scales(0.2, 1.0, (1.0, 0.5), (0.0, 0.0), (1.0, 1.0))
    spec = ModelSpec("structured", PLANT.coordinates, 4, scales, (0.05, 0.05))
    rng = np.random.default_rng(0)
    system = learned_system(spec, {name: 0.3 * rng.normal(size=s) for name, s in spec.shapes().items()})
    with instance(export_system(system, tmp_path, name="Learned", start={"alpha": 0.5})) as made:
        made.start()
        (h,) = made.get("solver_step")
        states = made.run(system.state_names, h, {"v": np.full(200, 5.0)})
    u = np.tile([[0.0], [5.0]], 200)
    expected = system.rk4().mapaccum(200)([0.5, 0.0, 0.0], u, [], h).full().T
    np.testing.assert_allclose(states, expected, rtol=0, atol=1e-12)


def test_a_compiler_that_fails_is_quoted_and_nothing_is_written(tmp_path: Path) -> None:
    script = tmp_path / "cc"
    script.write_text("#!/bin/sh\necho 'out of stamps' >&2\nexit 1\n")
    script.chmod(script.stat().st_mode | stat.S_IXUSR)
    with pytest.raises(RunError, match=r"the C compiler failed: .*all\.c.*\nout of stamps\n"):
        export_plant(PLANT, tmp_path / "x.fmu", Options(compiler=str(script)))
    assert not (tmp_path / "x.fmu").exists()


def test_a_path_that_cannot_be_written_is_a_storage_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match="could not be written"):
        export_plant(PLANT, tmp_path / "file" / "x.fmu")


def test_a_platform_that_is_not_known_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="unknown platform 'sparc-solaris'; expected one of x86_64-linux"):
        export_plant(PLANT, tmp_path, Options(platforms=("sparc-solaris",)))


def test_without_a_compiler_for_all_platforms_this_machines_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(platforms, "has_zig", lambda: False)
    assert platforms.buildable() == (platforms.host(),)
    other = next(name for name in platforms.PLATFORMS if name != platforms.host())
    with pytest.raises(InputError, match=f"no compiler for {other} here"):
        export_plant(PLANT, tmp_path, Options(platforms=(other,)))


def test_other_platforms_are_built_from_here(tmp_path: Path) -> None:
    pytest.importorskip("ziglang")
    names = ("x86_64-windows", "x86_64-darwin", "aarch64-darwin")
    path = export_system(PENDULUM, tmp_path, name="P", options=Options(platforms=names))
    with zipfile.ZipFile(path) as archive:
        windows, mac = (archive.read(f"binaries/{n}") for n in ("win64/P.dll", "darwin64/P.dylib"))
    assert windows[:2] == b"MZ"
    assert b"ucrtbase.dll" in windows
    assert mac[:8] == bytes.fromhex("cafebabe00000002")  # both processors in one library
    again = export_system(PENDULUM, tmp_path / "again.fmu", name="P", options=Options(platforms=names))
    assert again.read_bytes() == path.read_bytes()


def test_the_check_names_what_is_wrong(tmp_path: Path) -> None:
    path = export_system(PENDULUM, tmp_path, name="P", start={"theta": 1.0})
    assert check_fmu(path).problems == ()
    broken = tmp_path / "broken.fmu"
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(broken, "w") as new:
        for name in old.namelist():
            if name != "documentation/index.html":
                new.writestr(name, old.read(name))
    assert check_fmu(broken).problems == ("documentation/index.html is missing",)
    with pytest.raises(FmuError, match="cannot be read as an FMU"):
        check_fmu(Path(__file__))


def test_the_check_finds_a_model_that_moves_otherwise(tmp_path: Path) -> None:
    right = export_system(PENDULUM, tmp_path / "r.fmu", name="P", start={"theta": 1.0})
    wrong = tmp_path / "w.fmu"
    with zipfile.ZipFile(right) as old, zipfile.ZipFile(wrong, "w") as new:
        for name in old.namelist():
            content = old.read(name)
            if name.endswith("reference_out.csv"):
                lines = content.splitlines()
                content = b"\n".join([*lines[:-1], lines[-1].replace(b".", b".1", 1)])
            new.writestr(name, content)
    problems = check_fmu(wrong).problems
    assert len(problems) == 2
    assert "differs from the reference" in problems[0]
