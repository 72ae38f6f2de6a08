"""Generates `src/lookalike/v1`, the typed stubs of the public API, from the protos.

`setup.py` calls it, so that `pip install ./clients/python` needs nothing else. By hand, after a
change of the protos in an editable install: `python generate.py` (needs grpcio-tools and
mypy-protobuf).
"""

import shutil
import sys
import sysconfig
from pathlib import Path

HERE = Path(__file__).resolve().parent
PROTO = HERE.parent.parent / "proto"
SOURCES = PROTO / "lookalike" / "v1"
OUT = HERE / "src" / "lookalike" / "v1"
INIT = '"""Generated from `proto/lookalike/v1`: the messages and stubs of the public API."""\n'


def up_to_date() -> None:
    """Generates the stubs unless they are newer than the protos.

    Outside a checkout (a source distribution) there are no protos: what was packed is used.
    """
    if not SOURCES.is_dir():
        if not (OUT / "__init__.py").is_file():
            sys.exit(f"{SOURCES} is missing: install from a checkout of the whole repository")
        return
    # The mark of a whole run: it is written last.
    done = OUT / "__init__.py"
    newest = max(path.stat().st_mtime for path in [*protos(), Path(__file__)])
    if not done.is_file() or done.stat().st_mtime < newest:
        generate()


def generate() -> None:
    """Replaces the stubs."""
    # Only the build needs the compiler.
    import grpc_tools
    from grpc_tools import protoc

    if OUT.is_dir():
        shutil.rmtree(OUT)
    src = OUT.parent.parent
    common = ["protoc", f"-I{PROTO}", f"-I{Path(grpc_tools.__file__).parent / '_proto'}"]
    common += plugins(("protoc-gen-mypy", "protoc-gen-mypy_grpc"))
    messages = [f"--python_out={src}", f"--mypy_out=quiet:{src}", *map(str, protos())]
    # Only this file has anything to say about calls.
    service = str(SOURCES / "lookalike_service.proto")
    calls = [f"--grpc_python_out={src}", f"--mypy_grpc_out=quiet:{src}", service]
    for arguments in (messages, calls):
        if protoc.main(common + arguments) != 0:
            sys.exit("the protos do not compile: see the messages above")
    (OUT / "__init__.py").write_text(INIT)


def protos() -> list[Path]:
    """The protos of the public API, in a fixed order."""
    return sorted(SOURCES.glob("*.proto"))


def plugins(names: tuple[str, ...]) -> list[str]:
    """Where the compiler finds its plugins: an isolated build need not have them on its path."""
    found = []
    for name in names:
        beside = Path(sysconfig.get_path("scripts")) / name
        program = shutil.which(name) or (str(beside) if beside.is_file() else None)
        if program is None:
            sys.exit(f"{name} is missing: run `pip install mypy-protobuf`")
        found.append(f"--plugin={name}={program}")
    return found


if __name__ == "__main__":
    generate()
