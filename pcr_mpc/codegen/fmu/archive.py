"""A functional mock-up unit: sources, a binary for this computer, and what they are described by, in one file."""

from __future__ import annotations

import hashlib
import platform
import shutil
import sys
import tempfile
import uuid
import zipfile
from pathlib import Path

from ...errors import GenerationError
from ...files import replacing, stamp_archive
from ..folder import write_folder
from ..library import run_make
from ..subject import Subject
from .description import build_description, identifier, model_description
from .variables import Layout, layout

_FMI = Path(__file__).parent.parent / "c" / "fmi"
# What of a generated folder is about its example.
_LEFT_OUT = ("main.c", "pcr_vectors.h", "CMakeLists.txt")
# The same content makes the same file.
_DATE = (1980, 1, 1, 0, 0, 0)


def require_platform() -> str:
    """Name that FMI 3.0 has for this computer, of which there is a binary.

    Raises
    ------
    GenerationError
        There is none of it.
    """
    machine = {"AMD64": "x86_64", "arm64": "aarch64"}.get(platform.machine(), platform.machine())
    if sys.platform != "linux" or machine not in ("x86_64", "aarch64"):
        raise GenerationError(f"mock-up units are built on Linux for x86_64 or aarch64, and this is {sys.platform} on "
                              f"{machine}; pcr-mpc generate writes the same C", part="fmu")  # fmt: skip
    return f"{machine}-linux"


def write_fmu(subject: Subject, part: str, version: int, path: Path, *words: str) -> None:
    """Generate, compile and pack one part of a scene.

    Parameters
    ----------
    subject : Subject
    part : {"plant", "controller"}
    version : {2, 3}
        Of FMI.
    path : Path
        File to write.
    *words : str
        Variables of the folder's Makefile.

    Raises
    ------
    GenerationError
        There is no binary for this computer.
    CompilerError
        There is no compiler, or it failed.
    """
    place = require_platform()
    variables, model = layout(subject, part), identifier(subject.scene.name, part)
    with tempfile.TemporaryDirectory(prefix="pcr-mpc-") as temporary:
        folder = Path(temporary)
        token = write_sources(subject, variables, version, folder)
        run_make(folder, "-f", "fmu.mk", f"NAME={model}", f"PART={part}", f"VERSION={version}", *words)
        library = folder / f"{model}.so"
        binary = "linux64" if (version, place) == (2, "x86_64-linux") else place
        files = {f"binaries/{binary}/{model}.so": library.read_bytes(), **_texts(folder, version)}
        sources = sorted(name.removeprefix("sources/") for name in files if name.endswith(".c"))
        # DAQP's files are one unit, which includes the others.
        sources = [name for name in sources if not name.startswith("daqp/src/")]
        times = subject.scene.n_periods * subject.scene.period, subject.scene.period
        files["modelDescription.xml"] = model_description(
            variables, version, name=subject.scene.name, token=token, times=times, sources=sources
        )
        if version == 3:
            files["sources/buildDescription.xml"] = build_description(model, sources)
    with replacing(path) as draft:
        with zipfile.ZipFile(draft, "w", zipfile.ZIP_DEFLATED) as archive:
            for name in sorted(files, key=lambda name: (name != "modelDescription.xml", name)):
                archive.writestr(zipfile.ZipInfo(name, _DATE), files[name], zipfile.ZIP_DEFLATED)
        stamp_archive(draft)


def write_sources(subject: Subject, variables: Layout, version: int, folder: Path) -> str:
    """Write all C that one part needs into a folder; return the token that its binary knows."""
    write_folder(subject, None, folder)
    own = ("pcr_fmu.c", f"pcr_fmu_{variables.part}.c", f"pcr_fmi{version}.c", "pcr_fmu.h", "fmu.mk")
    for path in (*(_FMI / name for name in own), *_FMI.glob(f"fmi{version}*.h")):
        shutil.copyfile(path, folder / path.name)
    for name in _LEFT_OUT:
        (folder / name).unlink()
    (folder / "pcr_fmu_tables.c").write_text(variables.tables(), encoding="utf-8")
    step = subject.plant.dt if variables.part == "plant" else subject.scene.period
    content = hashlib.sha256(f"{version} {variables}".encode())
    for path in sorted(folder.rglob("*.[ch]")):
        content.update(path.read_bytes())
    token = f"{{{uuid.uuid5(uuid.NAMESPACE_OID, content.hexdigest())}}}"
    (folder / "pcr_fmu_config.h").write_text(variables.config(float(step), token), encoding="utf-8")
    return token


def _texts(folder: Path, version: int) -> dict[str, bytes]:
    """Files of an archive besides its binary: headers lie beside each other, as importers have one place for them."""
    found = {}
    for path in folder.rglob("*"):
        name = path.relative_to(folder).as_posix()
        if path.suffix == ".h":
            found[f"sources/{path.name}"] = path.read_bytes()
        elif path.suffix in (".c", ".mk") or path.name == "Makefile":
            found[f"sources/{name}"] = path.read_bytes()
        elif path.name == "LICENSE":
            found[f"documentation/licenses/{path.parent.name}.txt"] = path.read_bytes()
    found["documentation/licenses/fmi.txt"] = (_FMI / "LICENSE.txt").read_bytes()
    return found
