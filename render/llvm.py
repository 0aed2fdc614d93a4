"""Choosing a working LLVM before Dr.Jit is imported, and starting Mitsuba on it.

Dr.Jit reads `DRJIT_LIBLLVM_PATH` when it is imported. LLVM 15 and 16 pass `set_variant` and then abort the
process in the first render (their x86 back end cannot lower `llvm.minimum`), so anything below 19 is refused here.
"""

from __future__ import annotations

import importlib.metadata
import logging
import os
import re
import sys
from pathlib import Path
from types import ModuleType

from scenes.errors import InputError
from scenes.files import silenced

log = logging.getLogger(__name__)

VARIANT = "llvm_ad_mono"
OLDEST_LLVM = 19
PATH_VARIABLE = "DRJIT_LIBLLVM_PATH"
WHEEL = "karellen-llvm-core"
SYSTEM_PATTERNS = ("lib/*/libLLVM*.so*", "lib/llvm-*/lib/libLLVM*.so*", "lib64/libLLVM*.so*", "local/lib/libLLVM*.so*")
REMEDY = f"install the pinned wheel ({WHEEL}) or set {PATH_VARIABLE} to a libLLVM.so of version {OLDEST_LLVM} or newer"


def choose_llvm() -> Path | None:
    """The LLVM library to use: an explicit variable, else the pinned wheel, else the newest system LLVM >= 19.

    Raises InputError when the variable names a file that is not there.
    """
    explicit = os.environ.get(PATH_VARIABLE)
    if explicit:
        if not Path(explicit).is_file():
            raise InputError(f"{PATH_VARIABLE}={explicit}: no such file, expected a libLLVM.so >= {OLDEST_LLVM}")
        return Path(explicit)
    return wheel_llvm() or system_llvm()


def wheel_llvm() -> Path | None:
    """libLLVM of the pinned wheel, by its real file name: the symlinks appear only at the next interpreter start."""
    try:
        files = importlib.metadata.files(WHEEL) or []
    except importlib.metadata.PackageNotFoundError:
        return None
    found = [Path(f.locate()).resolve() for f in files if re.fullmatch(r"libLLVM\.so\.[\d.]+", f.name)]
    return next((path for path in found if path.is_file()), None)


def system_llvm(root: Path = Path("/usr")) -> Path | None:
    """The newest system libLLVM of version 19 or more, by file name (libLLVM.so.19.1, libLLVM-19.so.1)."""
    versions: dict[int, Path] = {}
    for pattern in SYSTEM_PATTERNS:
        for path in sorted(root.glob(pattern)):
            match = re.fullmatch(r"libLLVM(?:-(\d+)(?:[\d.]*)\.so.*|\.so\.(\d+)[\d.]*)", path.name)
            if match:
                versions.setdefault(int(match[1] or match[2]), path)
    newest = max(versions, default=0)
    return versions[newest] if newest >= OLDEST_LLVM else None


def start_mitsuba() -> ModuleType:
    """Import Mitsuba on a working LLVM, set the variant, and return the module. Idempotent.

    Raises InputError in one line if LLVM is missing or older than 19, also when the user imported Dr.Jit first or
    chose an old library by the variable.
    """
    if "drjit" not in sys.modules:
        library = choose_llvm()
        if library is not None:
            os.environ[PATH_VARIABLE] = str(library)
            log.debug("LLVM: %s", library)
    try:
        with silenced():  # Dr.Jit prints lines of its own before it raises
            import drjit as dr
            import mitsuba as mi

            if mi.variant() != VARIANT:
                mi.set_variant(VARIANT)
    except ImportError as error:
        reason = " ".join(str(error).split())[:160]
        raise InputError(f"Mitsuba finds no usable LLVM ({reason}); {REMEDY}") from None
    check_llvm_version(tuple(dr.detail.llvm_version()))
    mi.set_log_level(mi.LogLevel.Error)
    return mi


def check_llvm_version(version: tuple[int, ...]) -> None:
    """Refuse a version that would abort the process in the first render."""
    if not version or version[0] < OLDEST_LLVM:
        found = ".".join(map(str, version))
        raise InputError(
            f"LLVM {found or 'none'} would abort in the first render, {OLDEST_LLVM} is the oldest; {REMEDY}"
        )
