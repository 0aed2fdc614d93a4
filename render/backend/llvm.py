"""Choosing the backend, and a working LLVM before Dr.Jit is imported, and starting Mitsuba on it.

CUDA is taken where the driver's CUDA and OptiX libraries are found and Mitsuba starts on them, else LLVM on the CPU;
SCENE2SPAD_BACKEND=llvm|cuda forces one. This module has the name of the backend that needs care: Dr.Jit reads
`DRJIT_LIBLLVM_PATH` when it is imported, and LLVM 15 and 16 pass `set_variant` and then abort the process in the first
render (their x86 back end cannot lower `llvm.minimum`), so anything below 19 is refused here.
"""

from __future__ import annotations

import ctypes
import importlib.metadata
import logging
import os
import re
import sys
from pathlib import Path
from types import ModuleType

from render.backend.interrupts import interrupts_wait
from scenes.errors import InputError
from scenes.files import silenced

log = logging.getLogger(__name__)

VARIANTS = {"llvm": "llvm_ad_mono", "cuda": "cuda_ad_mono"}
BACKEND_VARIABLE = "SCENE2SPAD_BACKEND"
# the driver's libraries, and the variables by which Dr.Jit takes them from elsewhere
CUDA_LIBRARIES = {"cuda": "DRJIT_LIBCUDA_PATH", "nvoptix": "DRJIT_LIBOPTIX_PATH"}
OLDEST_LLVM = 19
PATH_VARIABLE = "DRJIT_LIBLLVM_PATH"
WHEEL = "karellen-llvm-core"
RELOADABLE_DRJIT = "1.5.0"
LLVM_BACKEND = 1 << 2  # of Dr.Jit's backends, a bit each
SYSTEM_PATTERNS = ("lib/*/libLLVM*.so*", "lib/llvm-*/lib/libLLVM*.so*", "lib64/libLLVM*.so*", "local/lib/libLLVM*.so*")
REMEDY = f"install the pinned wheel ({WHEEL}) or set {PATH_VARIABLE} to a libLLVM.so of version {OLDEST_LLVM} or newer"


def choose_llvm() -> Path | None:
    """Return the LLVM library to use: an explicit variable, else the pinned wheel, else the newest system LLVM >= 19.

    Raises InputError when the variable names a file that is not there.
    """
    explicit = os.environ.get(PATH_VARIABLE)
    if explicit:
        if not Path(explicit).is_file():
            raise InputError(f"{PATH_VARIABLE}={explicit}: no such file, expected a libLLVM.so >= {OLDEST_LLVM}")
        return Path(explicit)
    return wheel_llvm() or system_llvm()


def wheel_llvm() -> Path | None:
    """Return libLLVM of the pinned wheel, by its real file name: the symlinks appear only at the next interpreter
    start."""
    try:
        files = importlib.metadata.files(WHEEL) or []
    except importlib.metadata.PackageNotFoundError:
        return None
    found = [Path(f.locate()).resolve() for f in files if re.fullmatch(r"libLLVM\.so\.[\d.]+", f.name)]
    return next((path for path in found if path.is_file()), None)


def system_llvm(root: Path = Path("/usr")) -> Path | None:
    """Return the newest system libLLVM of version 19 or more, by file name (libLLVM.so.19.1, libLLVM-19.so.1)."""
    versions: dict[int, Path] = {}
    for pattern in SYSTEM_PATTERNS:
        for path in sorted(root.glob(pattern)):
            match = re.fullmatch(r"libLLVM(?:-(\d+)(?:[\d.]*)\.so.*|\.so\.(\d+)[\d.]*)", path.name)
            if match:
                versions.setdefault(int(match[1] or match[2]), path)
    newest = max(versions, default=0)
    return versions[newest] if newest >= OLDEST_LLVM else None


def backends() -> list[str]:
    """Return the backends to try, best first: what SCENE2SPAD_BACKEND forces, else CUDA if its libraries are there, and
    LLVM.

    Raises InputError when the variable names neither, or CUDA where a library of the driver is missing.
    """
    forced = os.environ.get(BACKEND_VARIABLE, "")
    if forced and forced not in VARIANTS:
        raise InputError(f"{BACKEND_VARIABLE}={forced}: no such backend, expected {' or '.join(VARIANTS)}")
    if forced == "llvm":
        return ["llvm"]
    missing = [name for name, variable in CUDA_LIBRARIES.items() if not _found(name, variable)]
    if forced == "cuda":
        if missing:
            raise InputError(f"{BACKEND_VARIABLE}=cuda: found no lib{missing[0]}.so of an NVIDIA driver; use llvm")
        return ["cuda"]
    return ["llvm"] if missing else ["cuda", "llvm"]


def _found(library: str, variable: str) -> bool:
    explicit = os.environ.get(variable)
    return Path(explicit).is_file() if explicit else loads(f"lib{library}.so.1")


def loads(library: str) -> bool:
    """Return whether the dynamic linker loads a library. ctypes.util.find_library would run a compiler, whose files a
    kill leaves."""
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def start_mitsuba() -> ModuleType:
    """Import Mitsuba on the first of `backends` that starts, set its variant, and return the module. Idempotent.

    A variant of ours that is set already stays. Raises InputError in one line if a forced backend does not start, or if
    LLVM is missing or older than 19, also when the user imported Dr.Jit first or chose an old library by the variable.
    """
    wanted = backends()
    library = choose_llvm() if "llvm" in wanted else None
    if library is not None and "drjit" not in sys.modules:
        os.environ[PATH_VARIABLE] = str(library)
        log.debug("LLVM: %s", library)
    elif library is not None and tuple(sys.modules["drjit"].detail.llvm_version())[:1] < (OLDEST_LLVM,):
        reload_llvm(library)
    for backend in wanted:
        try:
            # Dr.Jit, imported by half, aborts the process at its end; and it prints lines of its own before it raises.
            with interrupts_wait(), silenced():
                import drjit as dr
                import mitsuba as mi

                if mi.variant() not in [VARIANTS[name] for name in wanted]:
                    mi.set_variant(VARIANTS[backend])
        except (ImportError, RuntimeError) as error:
            reason = " ".join(str(error).split())[:160]
            if backend != wanted[-1]:
                log.info("backend: llvm, since cuda does not start (%s)", reason)
                continue
            if backend == "cuda":
                raise InputError(f"Mitsuba does not start on CUDA ({reason}); use {BACKEND_VARIABLE}=llvm") from None
            raise InputError(f"Mitsuba finds no usable LLVM ({reason}); {REMEDY}") from None
        break
    if mi.variant() == VARIANTS["llvm"]:
        check_llvm_version(tuple(dr.detail.llvm_version()))
    mi.set_log_level(mi.LogLevel.Error)
    return mi


def reload_llvm(library: Path) -> bool:
    """Start Dr.Jit again on another LLVM, where the user imported it first and it took an old one; whether it did.

    Done before any variant is set, when nothing has been computed, and with the Dr.Jit whose functions are known: its
    shared library has no public way. Otherwise nothing is changed, and the version is refused later.
    """
    drjit, mitsuba = sys.modules["drjit"], sys.modules.get("mitsuba")
    fresh = mitsuba is None or mitsuba.variant() is None
    if not fresh or getattr(drjit, "__version__", "") != RELOADABLE_DRJIT:
        return False
    try:
        core = ctypes.CDLL(str(Path(str(drjit.__file__)).with_name("libdrjit-core.so")))
        shut_down, start = (
            core._Z12jit_shutdowni,
            core._Z8jit_initj,
        )  # jit_shutdown(int light), jit_init(uint32 backends)
    except (OSError, AttributeError):
        return False
    os.environ[PATH_VARIABLE] = str(library)
    with silenced():
        shut_down(0)
        start(LLVM_BACKEND)
    return True


def check_llvm_version(version: tuple[int, ...]) -> None:
    """Refuse a version that would abort the process in the first render."""
    if not version or version[0] < OLDEST_LLVM:
        found = ".".join(map(str, version))
        wheel = None if os.environ.get(PATH_VARIABLE) else wheel_llvm()
        remedy = REMEDY if wheel is None else f"set {PATH_VARIABLE}={wheel} before Dr.Jit is imported"
        raise InputError(
            f"LLVM {found or 'none'} would abort in the first render, {OLDEST_LLVM} is the oldest; {remedy}"
        )
