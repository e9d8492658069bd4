"""Controllers of one's own, by name: ``module:Class``, which builds one for a scene."""

from __future__ import annotations

import difflib
import hashlib
import importlib
import importlib.util
import inspect
import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from ...errors import ModelError
from ..parts.controllers import Controller
from ..scene.scene import Scene


@dataclass(frozen=True)
class OwnController:
    """What builds a controller of one's own; can be pickled, and sent to other processes.

    Attributes
    ----------
    spec : str
        ``module:Class`` or ``file.py:Class``. A class or a function is called with the scene if it takes an argument
        without a default, else without; what is no class and has ``start`` and ``step`` is taken as it is.
    folder : str
        Where the module or the file is looked for first; by default where the command runs.
    """

    spec: str
    folder: str = ""

    def __post_init__(self) -> None:
        if ":" not in self.spec:
            raise ModelError(f"controller is {self.spec!r}, expected module:Class", key="controller")
        object.__setattr__(self, "folder", self.folder or str(Path.cwd()))

    @property
    def name(self) -> str:
        """Of what is called."""
        return self.spec.rpartition(":")[2]

    def described(self) -> dict[str, str]:
        """What a study notes of it: its name and a digest of its file."""
        module = self.spec.rpartition(":")[0]
        file = getattr(_loaded(module, self.folder, self.spec), "__file__", None)
        content = Path(file).read_bytes() if file is not None else b""
        return {"spec": self.spec, "source": hashlib.sha256(content).hexdigest()[:12]}

    def __call__(self, scene: Scene) -> Controller:
        """Build one for a scene.

        Raises
        ------
        ModelError
            There is no such module, or nothing of that name in it; or what the module does when it is loaded failed.
        """
        module, _, name = self.spec.rpartition(":")
        found = _loaded(module, self.folder, self.spec)
        if not hasattr(found, name):
            public = [one for one in vars(found) if not one.startswith("_")]
            near = difflib.get_close_matches(name, public, 1)
            hint = f"; did you mean {near[0]}?" if near else f"; it has {', '.join(public[:8]) or 'nothing'}"
            raise ModelError(f"{self.spec}: module {module} has no {name}{hint}", key="controller")
        return built(getattr(found, name), scene)


def built(maker: Any, scene: Scene) -> Controller:
    """Return the controller that a class or a function makes for a scene, or ``maker`` itself if it is one.

    Raises
    ------
    ModelError
        It is neither, or needs more arguments than a scene.
    """
    if not inspect.isclass(maker) and hasattr(maker, "start") and hasattr(maker, "step"):
        return maker  # type: ignore[no-any-return]
    if not callable(maker):
        raise ModelError(
            f"{maker!r} is no controller: expected a class or an object with start and step, or a function that "
            "returns one",
            key="controller",
        )
    try:
        signature = inspect.signature(maker)
    except (TypeError, ValueError):  # of a builtin, which does not tell
        return maker()  # type: ignore[no-any-return]
    for arguments in ((), (scene,)):
        try:
            signature.bind(*arguments)
        except TypeError:
            continue
        return maker(*arguments)  # type: ignore[no-any-return]
    raise ModelError(
        f"{getattr(maker, '__name__', maker)}{signature} needs more than a scene; give its arguments defaults, or name "
        "a function that takes the scene and returns the controller",
        key="controller",
    )


def _loaded(module: str, folder: str, spec: str) -> ModuleType:
    try:
        return _of_file(Path(folder, module)) if module.endswith(".py") else _of_name(module, folder)
    except ModuleNotFoundError as error:
        if error.name is not None and (module == error.name or module.startswith(f"{error.name}.")):
            raise ModelError(
                f"{spec}: there is no module {module} in {folder} nor among the installed ones", key="controller"
            ) from None
        raise ModelError(f"{spec}: loading it failed: {error}", key="controller") from error
    except FileNotFoundError:
        raise ModelError(f"{spec}: there is no file {Path(folder, module)}", key="controller") from None
    except Exception as error:
        raise ModelError(f"{spec}: loading it failed: {type(error).__name__}: {error}", key="controller") from error


def _of_name(module: str, folder: str) -> ModuleType:
    if folder in sys.path:
        return importlib.import_module(module)
    sys.path.insert(0, folder)
    try:
        return importlib.import_module(module)
    finally:
        sys.path.remove(folder)


def _of_file(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    if spec is None or spec.loader is None:
        raise ImportError(f"{path} cannot be loaded")
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module  # as what is pickled of it is looked up by its name
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[path.stem]
        raise
    return module
