"""The choice of LLVM. What could abort the process runs in one of its own."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from render import llvm
from scenes import InputError


def run(code: str, **environment: str) -> subprocess.CompletedProcess:
    inherited = {k: v for k, v in os.environ.items() if k != llvm.PATH_VARIABLE}
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, env={**inherited, **environment}
    )


START = """
from scenes import InputError
from render.llvm import start_mitsuba
try:
    mi = start_mitsuba()
except InputError as error:
    print('refused:', error)
else:
    import drjit as dr
    scene = mi.load_dict(mi.cornell_box())
    print('rendered', float(dr.mean(mi.render(scene, spp=1).array)[0]) > 0)
"""


def test_default_choice_renders():
    done = run(START)
    assert done.returncode == 0 and done.stdout.strip() == "rendered True", done.stderr


def test_missing_explicit_library_is_refused():
    done = run(START, DRJIT_LIBLLVM_PATH="/nowhere/libLLVM.so")
    assert done.returncode == 0 and done.stdout.startswith(
        "refused: DRJIT_LIBLLVM_PATH=/nowhere/libLLVM.so: no such file"
    )
    assert len(done.stdout.splitlines()) == 1


@pytest.mark.parametrize("version", [14, 15, 16])
def test_old_explicit_library_is_refused_before_it_can_abort(version):
    found = sorted(Path("/usr/lib").glob(f"*/libLLVM-{version}*.so*"))
    if not found:
        pytest.skip(f"no LLVM {version} on this machine")
    done = run(START, DRJIT_LIBLLVM_PATH=str(found[0]))
    assert done.returncode == 0 and done.stdout.startswith("refused: "), done.stderr
    assert "19" in done.stdout and len(done.stdout.splitlines()) == 1


@pytest.mark.parametrize("version", [(15, 0, 6), (16, 0, 0), (18, 1, 8), ()])
def test_old_version_is_refused_also_when_drjit_was_imported_first(version):
    code = f"""
import os
from render.llvm import wheel_llvm
os.environ['DRJIT_LIBLLVM_PATH'] = str(wheel_llvm() or '')
import drjit
drjit.detail.llvm_version = lambda: {version}
{START}"""
    done = run(code)
    assert done.returncode == 0 and "would abort in the first render" in done.stdout, done.stderr
    assert len(done.stdout.splitlines()) == 1


def test_no_llvm_at_all_is_one_line():
    # a name that exists nowhere stands for a machine without any LLVM; the check of the variable is stepped over
    code = START.replace("try:", "import render.llvm\nrender.llvm.choose_llvm = lambda: None\ntry:", 1)
    done = run(code, DRJIT_LIBLLVM_PATH="/nowhere/libLLVM.so")
    assert done.returncode == 0 and done.stdout.startswith("refused: "), done.stderr
    assert len(done.stdout.splitlines()) == 1 and done.stderr == ""


def test_explicit_variable_wins_over_the_wheel(monkeypatch, tmp_path):
    library = tmp_path / "libLLVM.so"
    library.touch()
    monkeypatch.setenv(llvm.PATH_VARIABLE, str(library))
    assert llvm.choose_llvm() == library
    monkeypatch.setenv(llvm.PATH_VARIABLE, str(tmp_path / "missing.so"))
    with pytest.raises(InputError, match="no such file"):
        llvm.choose_llvm()


def test_wheel_comes_before_the_system(monkeypatch):
    monkeypatch.delenv(llvm.PATH_VARIABLE, raising=False)
    monkeypatch.setattr(llvm, "wheel_llvm", lambda: Path("wheel"))
    monkeypatch.setattr(llvm, "system_llvm", lambda: Path("system"))
    assert llvm.choose_llvm() == Path("wheel")
    monkeypatch.setattr(llvm, "wheel_llvm", lambda: None)
    assert llvm.choose_llvm() == Path("system")


def test_system_search_takes_the_newest_from_19_on(tmp_path):
    folder = tmp_path / "lib" / "x86_64-linux-gnu"
    folder.mkdir(parents=True)
    for name in ("libLLVM-15.so.1", "libLLVM-16.so.1", "libLLVMIgnored.so.99"):
        (folder / name).touch()
    assert llvm.system_llvm(tmp_path) is None
    (folder / "libLLVM.so.19.1").touch()
    assert llvm.system_llvm(tmp_path).name == "libLLVM.so.19.1"
    (folder / "libLLVM-22.so.1").touch()
    assert llvm.system_llvm(tmp_path).name == "libLLVM-22.so.1"
