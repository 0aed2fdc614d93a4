"""The choice of backend and LLVM. What could abort the process runs in one of its own."""

import os
import subprocess
import sys
import types
from pathlib import Path

import pytest
from processes import run_process

from render.backend import llvm
from scenes import InputError


def run(code: str, **environment: str) -> subprocess.CompletedProcess:
    inherited = {k: v for k, v in os.environ.items() if k != llvm.PATH_VARIABLE}
    return run_process([sys.executable, "-c", code], env={**inherited, **environment})


START = """
from scenes import InputError
from render.backend.llvm import start_mitsuba
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


def test_ctrl_c_while_dr_jit_is_imported_waits_for_its_end():
    """Imported by half, Dr.Jit would abort the process (status -6)."""
    interrupting = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
class Interrupting:
    def find_spec(self, name, path, target=None):
        if name == "drjit.detail":
            signal.raise_signal(signal.SIGINT)
sys.meta_path.insert(0, Interrupting())
from render.backend.llvm import start_mitsuba
try:
    start_mitsuba()
except KeyboardInterrupt:
    print("interrupted", start_mitsuba().variant())
"""
    done = run(interrupting)
    assert done.returncode == 0 and done.stdout.split()[0] == "interrupted" and "_ad_mono" in done.stdout, done.stderr


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
from render.backend.llvm import wheel_llvm
os.environ['DRJIT_LIBLLVM_PATH'] = str(wheel_llvm() or '')
import drjit
drjit.detail.llvm_version = lambda: {version}
{START}"""
    done = run(code)
    assert done.returncode == 0 and "would abort in the first render" in done.stdout, done.stderr
    assert len(done.stdout.splitlines()) == 1


@pytest.mark.parametrize("first", ["import mitsuba", "import drjit", "import mitsuba; import drjit"])
def test_mitsuba_imported_first_takes_the_pinned_llvm(first):
    """Dr.Jit has then chosen the system's newest LLVM, which may be one that aborts."""
    done = run(f"{first}\n{START}\nprint(tuple(dr.detail.llvm_version())[0])")
    assert done.returncode == 0 and done.stdout.split()[:2] == ["rendered", "True"], done.stdout + done.stderr
    assert int(done.stdout.split()[2]) >= llvm.OLDEST_LLVM


def test_where_dr_jit_cannot_start_again_the_wheel_is_named():
    """Another Dr.Jit, whose functions are not known: one line with the exact path to set."""
    code = f"""
import mitsuba, drjit
drjit.__version__ = "9.9.9"
drjit.detail.llvm_version = lambda: (15, 0, 6)
{START}"""
    done = run(code)
    assert done.returncode == 0 and done.stdout.startswith("refused: LLVM 15.0.6"), done.stdout + done.stderr
    assert f"set DRJIT_LIBLLVM_PATH={llvm.wheel_llvm()} before" in done.stdout


def test_no_llvm_at_all_is_one_line():
    # a name that exists nowhere stands for a machine without any LLVM; the check of the variable is stepped over
    code = START.replace("try:", "import render.backend.llvm\nrender.backend.llvm.choose_llvm = lambda: None\ntry:", 1)
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


# ---- CUDA or LLVM, without a GPU: the driver's libraries and Mitsuba itself are stand-ins ----


class FakeMitsuba(types.ModuleType):
    """Starts on the variants it is told to, and refuses the others as Mitsuba does."""

    LogLevel = types.SimpleNamespace(Error=0)

    def __init__(self, *works: str) -> None:
        super().__init__("mitsuba")
        self.works, self.chosen, self.tried = works, None, []

    def variant(self):
        return self.chosen

    def set_variant(self, name):
        self.tried.append(name)
        if name not in self.works:
            raise ImportError(f"{name}: could not\nbe started")
        self.chosen = name

    def set_log_level(self, level):
        pass


@pytest.fixture
def machine(monkeypatch):
    """Set up a machine: which driver libraries it has, which variants start, what LLVM says it is."""

    def set_up(libraries=(), works=("llvm_ad_mono",), version=(23, 1, 4), backend=None):
        for name in (llvm.BACKEND_VARIABLE, *llvm.CUDA_LIBRARIES.values()):
            monkeypatch.delenv(name, raising=False)
        if backend is not None:
            monkeypatch.setenv(llvm.BACKEND_VARIABLE, backend)
        monkeypatch.setattr(llvm, "loads", lambda name: name in {f"lib{library}.so.1" for library in libraries})
        drjit = types.ModuleType("drjit")
        drjit.detail = types.SimpleNamespace(llvm_version=lambda: version)
        mitsuba = FakeMitsuba(*works)
        monkeypatch.setitem(sys.modules, "drjit", drjit)
        monkeypatch.setitem(sys.modules, "mitsuba", mitsuba)
        return mitsuba

    return set_up


def test_a_library_is_looked_for_without_a_compiler(monkeypatch):
    """Killed in that moment, a compiler leaves its temporary files."""

    def started(*_, **__):
        raise AssertionError("a process was started")

    monkeypatch.setattr("subprocess.Popen", started)
    monkeypatch.setattr("os.popen", started)
    assert llvm.loads("libc.so.6") and not llvm.loads("libnobody-has-this.so.1")


BOTH = ("cuda", "nvoptix")
EVERY = ("cuda_ad_mono", "llvm_ad_mono")


def test_cuda_is_taken_where_driver_and_optix_are_there(machine):
    fake = machine(BOTH, EVERY, version=())  # no LLVM at all: nobody asks for it
    assert llvm.start_mitsuba() is fake and fake.chosen == "cuda_ad_mono"
    assert llvm.start_mitsuba() is fake and fake.tried == ["cuda_ad_mono"]


@pytest.mark.parametrize("libraries", [(), ("cuda",), ("nvoptix",)])
def test_llvm_is_taken_without_driver_or_optix(machine, libraries):
    fake = machine(libraries, EVERY)
    llvm.start_mitsuba()
    assert fake.tried == ["llvm_ad_mono"]


def test_llvm_is_taken_where_cuda_does_not_start(machine):
    fake = machine(BOTH)
    llvm.start_mitsuba()
    assert fake.tried == ["cuda_ad_mono", "llvm_ad_mono"] and fake.chosen == "llvm_ad_mono"
    machine(BOTH, version=(15, 0, 6))
    with pytest.raises(InputError, match="would abort"):
        llvm.start_mitsuba()


def test_the_variable_forces_a_backend(machine):
    fake = machine(BOTH, EVERY, backend="llvm")
    llvm.start_mitsuba()
    assert fake.tried == ["llvm_ad_mono"]
    fake = machine(BOTH, EVERY, backend="cuda")
    llvm.start_mitsuba()
    assert fake.tried == ["cuda_ad_mono"]


@pytest.mark.parametrize(
    ("set_up", "message"),
    [
        ({"backend": "metal"}, "SCENE2SPAD_BACKEND=metal: no such backend, expected llvm or cuda"),
        ({"backend": "cuda"}, "SCENE2SPAD_BACKEND=cuda: found no libcuda.so of an NVIDIA driver; use llvm"),
        ({"backend": "cuda", "libraries": ("cuda",)}, "found no libnvoptix.so"),
        ({"backend": "cuda", "libraries": BOTH}, "does not start on CUDA"),
        ({"works": ()}, "finds no usable LLVM"),
    ],
)
def test_a_backend_that_cannot_be_had_is_one_line(machine, set_up, message):
    machine(**set_up)
    with pytest.raises(InputError) as error:
        llvm.start_mitsuba()
    assert message in str(error.value) and "\n" not in str(error.value)


def test_explicit_driver_libraries_count(machine, monkeypatch, tmp_path):
    fake = machine((), EVERY)
    for name in llvm.CUDA_LIBRARIES.values():
        (tmp_path / name).touch()
        monkeypatch.setenv(name, str(tmp_path / name))
    llvm.start_mitsuba()
    assert fake.chosen == "cuda_ad_mono"


def test_a_forced_backend_reaches_a_real_process():
    done = run(START, SCENE2SPAD_BACKEND="llvm")
    assert done.returncode == 0 and done.stdout.strip() == "rendered True", done.stderr
    done = run(START, SCENE2SPAD_BACKEND="quantum")
    assert done.stdout.strip() == "refused: SCENE2SPAD_BACKEND=quantum: no such backend, expected llvm or cuda"
