"""Machine code of loops: kept on disk, loaded without the compiler, and called with arrays.

Numba is hundreds of modules, and takes a second before it has read what it keeps on disk itself.  LLVM alone loads the
same machine code in milliseconds.
"""

from __future__ import annotations

import ctypes
import hashlib
import importlib.util
import os
import re
import struct
import tempfile
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

Loop = Callable[..., None]
# Names of numbers in NumPy, LLVM and ``struct``, padded to eight bytes.
_NUMBERS = {"int64": ("i64", "q"), "float32": ("float", "f4x"), "float64": ("double", "d")}
# Name of what is called, and bytes of a digest.
_ENTRY, _DIGEST = "turbrestore_loop", 32
# Flags of arrays: C order, and aligned.
IN_ORDER = 0x101
# Where the structure of an array, which is part of the binary interface of NumPy, has data, shape and strides, bytes.
_HEAD = object.__basicsize__
_DATA, _SHAPE, _STRIDES = _HEAD, _HEAD + 16, _HEAD + 24


class Kind(NamedTuple):
    """What a compiled loop knows of an argument: a number, or an array in C order."""

    type: str
    dimensions: int | None = None

    @property
    def parameters(self) -> list[str]:
        """LLVM's types of what Numba passes for it: an array is passed as the fields of a structure."""
        if self.dimensions is None:
            return [_NUMBERS[self.type][0]]
        return ["ptr", "ptr", "i64", "i64", "ptr", *["i64"] * (2 * self.dimensions)]


def kind_of(value: Any) -> Kind | None:
    """Tell the kind of an argument; None for what only Numba can take."""
    if isinstance(value, np.ndarray):
        simple = value.flags.num & IN_ORDER == IN_ORDER and value.dtype.isnative and value.dtype.kind in "fiu"
        return Kind(value.dtype.name, value.ndim) if simple else None
    if isinstance(value, int | np.int64) and not isinstance(value, bool):
        return Kind("int64")
    if isinstance(value, np.float32):
        return Kind("float32")
    return Kind("float64") if isinstance(value, float) else None


def keepable() -> bool:
    """Whether LLVM writes its intermediate code as it is read here, which has pointers without types since 20."""
    import llvmlite

    return tuple(int(part) for part in llvmlite.__version__.split(".")[:2]) >= (0, 45) and struct.calcsize("P") == 8


def translate(ir: str, kinds: Sequence[Kind]) -> bytes:
    """Machine code of a loop from the intermediate code that Numba made of it.

    Raises
    ------
    ValueError
        Numba passes arguments in another way.
    RuntimeError
        LLVM does not understand the code.
    """
    import llvmlite.binding as llvm

    # Wrappers for calls from Python need Numba.
    lean = re.sub(r'^define [^\n]*@"?(?:_ZN7cpython|cfunc\.)[^\n]*\{\n.*?^\}\n', "", ir, flags=re.M | re.S)
    if re.search(r"call [^\n]*@(?:numba_|Py|NRT_(?!incref|decref|MemInfo_call_dtor))", lean):
        raise ValueError("the loop needs Numba, where it allocates memory for example")
    found = re.search(r'^define (?!linkonce_odr)[^\n]*?i32 @("[^"\n]+"|[\w.$]+)\(([^\n]*)\{$', lean, flags=re.M)
    expected = ["ptr", "ptr", *(parameter for kind in kinds for parameter in kind.parameters)]
    if found is None or re.findall(r"\b(ptr|i\d+|float|double)\b[^%,]*%", found[2]) != expected:
        raise ValueError("arguments are passed in another way")
    module = llvm.parse_assembly(lean + _entry(found[1], kinds))
    return bytes(_machine().emit_object(module))


def _entry(symbol: str, kinds: Sequence[Kind]) -> str:
    """Intermediate code of a function that reads the arguments of a loop from a row of numbers and addresses."""
    lines, passed = ["%result = alloca ptr", "%error = alloca ptr"], ["ptr %result", "ptr %error"]
    for number, kind in enumerate(kinds):
        a, taken = f"%a{number}", kind.parameters[0]
        lines += [f"{a}.at = getelementptr i64, ptr %values, i64 {number}", f"{a} = load {taken}, ptr {a}.at"]
        if kind.dimensions is None:
            passed.append(f"{taken} {a}")
            continue
        for name, at in (("data", _DATA), ("shape", _SHAPE), ("strides", _STRIDES)):
            lines += [f"{a}.{name}.at = getelementptr i8, ptr {a}, i64 {at}"]
            lines += [f"{a}.{name} = load ptr, ptr {a}.{name}.at"]
        size, fields = "1", []
        for name in ("shape", "strides"):
            for axis in range(kind.dimensions):
                field = f"{a}.{name}.{axis}"
                lines += [f"{field}.at = getelementptr i64, ptr {a}.{name}, i64 {axis}"]
                lines += [f"{field} = load i64, ptr {field}.at"]
                fields.append(f"i64 {field}")
                if name == "shape":
                    lines.append(f"{a}.size.{axis} = mul i64 {size}, {field}")
                    size = f"{a}.size.{axis}"
        passed += ["ptr null", "ptr null", f"i64 {size}", f"i64 {np.dtype(kind.type).itemsize}", f"ptr {a}.data"]
        passed += fields
    lines += [f"%status = call i32 @{symbol}({', '.join(passed)})", "ret i32 %status"]
    return f"\ndefine i32 @{_ENTRY}(ptr %values) {{\n" + "\n".join(lines) + "\n}\n"


def load(code: bytes, name: str, kinds: Sequence[Kind]) -> Loop:
    """Make a loop of machine code that can be called with arguments of the given kinds.

    Raises
    ------
    RuntimeError
        The code needs something of Numba.
    """
    import llvmlite.binding as llvm

    library = llvm.JITLibraryBuilder().add_object_img(code).add_current_process().export_symbol(_ENTRY)
    # Arrays that Python owns are never freed in a loop.
    library.import_symbol("NRT_MemInfo_call_dtor", ctypes.cast(ctypes.pythonapi.Py_FatalError, ctypes.c_void_p).value)
    loaded = library.link(_linker(), name)
    call = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_char_p)(loaded[_ENTRY])
    arrays = tuple(kind.dimensions is not None for kind in kinds)
    formats = ("q" if is_array else _NUMBERS[kind.type][1] for kind, is_array in zip(kinds, arrays, strict=True))
    layout = struct.Struct("=" + "".join(formats))

    def run(*values: Any) -> None:
        # The address of an array is its identity; the caller holds the array.
        if call(
            layout.pack(*(id(value) if is_array else value for value, is_array in zip(values, arrays, strict=True)))
        ):
            raise RuntimeError(f"{name}: an exception in a compiled loop")

    # LLVM frees what nobody holds.
    run.__dict__["loaded"] = loaded
    return run


@cache
def _machine() -> Any:
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    target, features = llvm.Target.from_default_triple(), llvm.get_host_cpu_features().flatten()
    return target.create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=features, opt=3, reloc="pic", codemodel="default"
    )


@cache
def _linker() -> Any:
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm.create_lljit_compiler()


class Kept:
    """Machine code of one loop for one list of kinds, in a file beside the compiled Python."""

    def __init__(self, function: Callable[..., None], options: object, kinds: Sequence[Kind]) -> None:
        import llvmlite
        import llvmlite.binding as llvm

        code, source = function.__code__, Path(function.__code__.co_filename)
        used = [(name, function.__globals__.get(name)) for name in code.co_names]
        # Numba takes them as they are when it compiles; what else a loop uses is part of NumPy.
        constants = [(name, repr(value)) for name, value in used if isinstance(value, int | float | np.number | tuple)]
        machine = llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()
        made_for = repr((llvmlite.__version__, machine, *kinds)).encode()
        self.name = f"{source.stem}.{code.co_name}-{hashlib.sha256(made_for).hexdigest()[:16]}"
        made_of = repr((code.co_code, code.co_consts, constants, options, _entry("loop", kinds))).encode()
        self._source, self._digest = source, hashlib.sha256(made_of + made_for).digest()

    def read(self) -> bytes | None:
        """Return the machine code; None if there is none of this very function."""
        for path in self._places():
            try:
                kept = path.read_bytes()
            except OSError:
                continue
            head, code = kept[: 2 * _DIGEST], kept[2 * _DIGEST :]
            if head == self._digest + hashlib.sha256(code).digest():
                return code
        return None

    def write(self, code: bytes) -> None:
        """Keep the machine code where there is a place for it."""
        for path in self._places():
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                number, begun = tempfile.mkstemp(dir=path.parent)
            except OSError:
                continue
            try:
                with os.fdopen(number, "wb") as file:
                    file.write(self._digest + hashlib.sha256(code).digest() + code)
                Path(begun).replace(path)
            except OSError:
                Path(begun).unlink(missing_ok=True)
                continue
            return

    def _places(self) -> list[Path]:
        """Folders as of Numba."""
        if not self._source.is_file():
            return []
        chosen = os.environ.get("NUMBA_CACHE_DIR")
        beside = Path(importlib.util.cache_from_source(str(self._source))).parent
        user = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "turbrestore"
        return [folder / f"{self.name}.o" for folder in ((Path(chosen),) if chosen else (beside, user))]
