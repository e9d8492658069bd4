"""``modelDescription.xml`` of FMI 2.0 and 3.0, and ``buildDescription.xml`` of FMI 3.0."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from importlib.metadata import version as installed

from ..ctext import number
from .variables import Layout, Variable

VERSIONS = (2, 3)
CATEGORIES = ("logStatusWarning", "logStatusDiscard", "logStatusError")
# Units that are made of others.
_DERIVED = {"N": {"kg": 1, "m": 1, "s": -2}}


def unit_exponents(unit: str) -> dict[str, int]:
    """Exponents of the base units of one that is written such as ``N s/m`` or ``1/rad^2``."""
    found: dict[str, int] = {}
    for side, words in enumerate(unit.split("/")):
        for word in words.split():
            symbol, _, power = word.partition("^")
            factor = (-1 if side else 1) * int(power or 1)
            for base, exponent in ({} if symbol == "1" else _DERIVED.get(symbol, {symbol: 1})).items():
                found[base] = found.get(base, 0) + factor * exponent
    return {base: exponent for base, exponent in found.items() if exponent}


def identifier(scene: str, part: str) -> str:
    """Name of a model that C may have."""
    return re.sub(r"\W", "_", f"pcr_{scene}_{part}", flags=re.ASCII)


def model_description(
    layout: Layout, version: int, *, name: str, token: str, times: tuple[float, float], sources: Sequence[str]
) -> bytes:
    """Bytes of ``modelDescription.xml``.

    Parameters
    ----------
    layout : Layout
    version : {2, 3}
    name : str
        Of the scene.
    token : str
        By which the binary knows that it belongs to this.
    times : tuple of float
        Duration of the scene and step between communications [s].
    sources : sequence of str
        Files of C.
    """
    two = version == 2
    model = identifier(name, layout.part)
    root = ET.Element("fmiModelDescription", {
        "fmiVersion": "2.0" if two else "3.0",
        "modelName": f"{name}, {layout.part}",
        "guid" if two else "instantiationToken": token,
        "description": f"The {layout.part} of the scene {name}: a planar parallel continuum robot",
        "generationTool": f"pcr-mpc {installed('pcr_mpc')}",
        "variableNamingConvention": "structured",
    })  # fmt: skip
    state = "state" if two else "State"
    about = {
        "modelIdentifier": model,
        "canHandleVariableCommunicationStepSize": "true",
        f"canGetAndSetFMU{state}": "true",
        f"canSerializeFMU{state}": "true",
    }
    if two:
        about["canNotUseMemoryManagementFunctions"] = "true"
    kind = ET.SubElement(root, "CoSimulation", about)
    if two:
        _files(ET.SubElement(kind, "SourceFiles"), "File", sources)
    _units(root, layout)
    categories = ET.SubElement(root, "LogCategories")
    for category in CATEGORIES:
        ET.SubElement(categories, "Category", {"name": category})
    duration, step = times
    ET.SubElement(root, "DefaultExperiment", {"startTime": "0", "stopTime": f"{duration:g}", "stepSize": f"{step:g}"})
    references = _variables(ET.SubElement(root, "ModelVariables"), layout, two=two)
    structure = ET.SubElement(root, "ModelStructure")
    if two:
        for group in ("Outputs", "InitialUnknowns"):
            element = ET.SubElement(structure, group)
            for at in references:
                ET.SubElement(element, "Unknown", {"index": str(at + 1)})
    else:
        for group in ("Output", "InitialUnknown"):
            for at in references:
                ET.SubElement(structure, group, {"valueReference": str(at)})
    return _bytes(root)


def build_description(model: str, sources: Sequence[str]) -> bytes:
    """Bytes of ``buildDescription.xml``."""
    root = ET.Element("fmiBuildDescription", {"fmiVersion": "3.0"})
    build = ET.SubElement(root, "BuildConfiguration", {"modelIdentifier": model})
    files = ET.SubElement(build, "SourceFileSet", {"language": "C99", "compilerOptions": "-ffp-contract=off"})
    _files(files, "SourceFile", sources)
    return _bytes(root)


def _files(parent: ET.Element, tag: str, names: Sequence[str]) -> None:
    for name in names:
        ET.SubElement(parent, tag, {"name": name})


def _units(root: ET.Element, layout: Layout) -> None:
    kinds = ("inputs", "fixed", "tunable", "outputs")
    used = {variable.unit for kind in kinds for variable in layout.flat(kind) if variable.unit}
    definitions = ET.SubElement(root, "UnitDefinitions")
    for unit in sorted(used | {"s"}):
        element = ET.SubElement(definitions, "Unit", {"name": unit})
        exponents = {base: str(exponent) for base, exponent in unit_exponents(unit).items()}
        ET.SubElement(element, "BaseUnit", exponents)


def _variables(parent: ET.Element, layout: Layout, *, two: bool) -> list[int]:
    """Write all variables; return the value references of the outputs, which are their places too."""
    at, outputs = 0, []
    roles = {
        "inputs": ("input", "continuous", None),
        "fixed": ("parameter", "fixed", "exact"),
        "tunable": ("parameter", "tunable", "exact"),
        "outputs": ("output", "continuous", "calculated"),
        "wholes": ("output", "discrete", "calculated"),
    }
    for kind, (causality, variability, initial) in roles.items():
        for variable in layout.flat(kind):
            about = {
                "name": variable.name,
                "valueReference": str(at),
                "description": variable.text,
                "causality": causality,
                "variability": variability,
            }
            if initial is not None:
                about["initial"] = initial
            _variable(parent, variable, about, whole=kind == "wholes", two=two)
            outputs += [at] if causality == "output" else []
            at += 1
    if not two:
        ET.SubElement(parent, "Float64", {
            "name": "time", "valueReference": str(at), "causality": "independent", "variability": "continuous",
            "unit": "s",
        })  # fmt: skip
    return outputs


def _variable(parent: ET.Element, variable: Variable, about: dict[str, str], *, whole: bool, two: bool) -> None:
    details = {"unit": variable.unit} if variable.unit else {}
    if variable.start is not None:
        details["start"] = number(variable.start).replace("INFINITY", "INF")
    if two:
        scalar = ET.SubElement(parent, "ScalarVariable", about)
        ET.SubElement(scalar, "Integer" if whole else "Real", details)
    else:
        ET.SubElement(parent, "Int32" if whole else "Float64", about | details)


def _bytes(root: ET.Element) -> bytes:
    ET.indent(root)
    found: bytes = ET.tostring(root, encoding="UTF-8", xml_declaration=True)
    return found + b"\n"
