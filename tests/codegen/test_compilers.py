"""What compilers, sanitisers and the list of symbols say of the generated C."""

import re
import shutil
import subprocess

import pytest

from tests.codegen.conftest import INCLUDED, QUICK, copied, make, needs_compiler, run


@needs_compiler
@pytest.mark.slow
def test_sanitisers_find_nothing(each, tmp_path):
    folder = copied(each, tmp_path)
    checked = "-O0 -fsanitize=address,undefined -fno-sanitize-recover=all"
    # Instructions without an index, which is what CasADi writes, take long to be checked.
    make(folder, f"CFLAGS={checked}", "GRAPH_CFLAGS=-O0")
    run(folder)


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("compiler", ["gcc", "clang"])
def test_no_compiler_warns_of_the_runtime(compiler, each):
    if not shutil.which(compiler):
        pytest.skip(f"there is no {compiler} here")
    own = sorted(path.name for path in each.glob("*.c"))
    assert {"main.c", "pcr_controller.c", "pcr_graphs.c", "pcr_tables.c", "pcr_qp.c"} < set(own)
    words = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O2", "-fsyntax-only", "-I.", *INCLUDED]
    done = subprocess.run([compiler, *words, *own], cwd=each, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@needs_compiler
@pytest.mark.slow
def test_cpp_may_include_the_header(each, tmp_path):
    if not shutil.which("g++"):
        pytest.skip("there is no g++ here")
    program = tmp_path / "main.cpp"
    program.write_text('#include "pcr.h"\nint main() { static pcr_plant p; return pcr_plant_init(&p, nullptr); }\n')
    words = ["-std=c++11", "-Wall", "-Wextra", "-Werror", "-fsyntax-only", "-I.", *INCLUDED]
    done = subprocess.run(["g++", *words, str(program)], cwd=each, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@needs_compiler
@pytest.mark.slow
def test_nothing_of_the_library_allocates_or_prints(each, tmp_path):
    folder = copied(each, tmp_path)
    make(folder, *QUICK, "size")
    kept, whole = ((folder / name).stat().st_size for name in ("controller.linked", "libpcr.a"))
    assert 50e3 < kept < whole
    listed = subprocess.run(["nm", "-u", str(folder / "libpcr.a")], capture_output=True, text=True, check=True).stdout
    needed = {line.split()[-1] for line in listed.splitlines() if " U " in f" {line}"}
    assert "sqrt" in needed  # it lists what it should
    banned = re.compile(r"alloc|^free$|print|put[sc]|^f?write$|errno|locale|^exit$|^abort$")
    assert not [name for name in needed if banned.search(name)]
    held = subprocess.run(["nm", str(folder / "libpcr.a")], capture_output=True, text=True, check=True).stdout
    variables = [line.split() for line in held.splitlines() if re.search(r" [bBC] ", line)]
    assert not variables  # state is in the structures alone
